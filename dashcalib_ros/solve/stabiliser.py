"""A stabilised video: how far its crop moved in each image is found and taken out of the tracks.

A stabiliser moves the crop against the car's turning, so that the principal point moves through
the picture. That looks much like a rotation, and makes focal lengths wrong by up to 20 %. What
tells them apart is the lens: its distortion moves with the crop, and a rotation moves the rim of
the picture farther than its middle. So the shift of each image is a parameter of the solution; the
tracks are moved to where a fixed crop would have seen them, and all is adjusted again.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.config import Config
from dashcalib_ros.reconstruct.adjust import Solver, adjust_step2
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.solve.departures import READOUT_S, Crops, Problem, problem_of, shift_priors
from dashcalib_ros.solve.fitting import retriangulate_all
from dashcalib_ros.solve.normal import IMAGE
from dashcalib_ros.solve.prior import bounds_of, loss_px_of, prior_of
from dashcalib_ros.solve.shutter import row_shift
from dashcalib_ros.solve.steps import Result

# of the width; the longest step of a shift in one round
LONGEST_STEP = 0.04
# times what chance gains; a step that gains less is the last one
SETTLED = 2.0


def without_crops(scene: Scene, crops: Crops) -> Scene:
    """Return the scene with the tracks that a fixed crop would have given."""
    moved = scene.tracks.xy - crops[scene.turn][:, None]
    return replace(scene, tracks=replace(scene.tracks, xy=moved))


def without_stabiliser(given: Result, config: Config, rounds: int) -> Result:
    """Return the result with the movement of the crop taken out, in so many rounds at the most.

    The same result if a turn is lost. A rolling shutter that was taken out before is estimated
    anew together with the crop.
    """
    settings = config.intrinsics
    crops = given.fit.crops or {scene.turn: np.zeros((len(scene.tracks.frames), 2))
                                for scene in given.fit.scenes}
    now = replace(given, fit=replace(given.fit, crops=crops))
    for _ in range(rounds):
        fit = now.fit
        loss_px = loss_px_of(fit.scenes, fit.camera, settings)
        shutter = [row_shift(scene, fit.camera) for scene in fit.scenes] if fit.readout_s else []
        problem = problem_of(fit.scenes, fit.camera, now.step1, loss_px, settings,
                             [shift[..., None] for shift in shutter],
                             [READOUT_S] * bool(shutter))
        now, strength = _step(now, problem, shutter)
        found, camera = adjust_step2(
            now.fit.scenes, now.fit.camera, Solver(loss_px, config.scene.iterations),
            prior_of(now.step1, settings, problem.noise), bounds_of(now.step1, settings))
        scenes = retriangulate_all(found, camera, config.scene)
        if len(scenes) < len(given.fit.scenes):
            return given
        now = replace(now, fit=replace(now.fit, scenes=scenes, camera=camera))
        if strength < SETTLED:
            break
    loss_px = loss_px_of(now.fit.scenes, now.fit.camera, settings)
    return replace(now, fit=replace(now.fit, solver=replace(now.fit.solver, loss_px=loss_px)))


def _step(now: Result, problem: Problem, shutter: Sequence[Floats]) -> tuple[Result, float]:
    """Return what one Gauss-Newton step makes of it, and how clear the step is."""
    fit, camera = now.fit, now.fit.camera
    count, lens = len(camera.names()), len(camera.widened().names())
    shared = range(count, lens + bool(shutter))
    priors = shift_priors(problem, now.settings, fit.crops)
    moving = problem.solved(priors, shared)
    strength = moving.strength(problem.solved(None, shared))
    moving = problem.solved(priors, shared, max(strength, 1.0))
    longest = float(np.abs(np.concatenate(moving.images)).max())
    part = min(1.0, LONGEST_STEP * camera.image_size[0] / max(longest, 1e-9))
    step_s = part * float(moving.shared[-1]) if shutter else 0.0
    scenes, crops = [], dict(fit.crops)
    for n, (scene, normal) in enumerate(zip(fit.scenes, problem.normals, strict=True)):
        step = np.zeros(len(normal.score))
        step[priors[n].free] = part * moving.images[n]
        step[IMAGE * normal.images:IMAGE * normal.images + count] = part * moving.shared[:count]
        crop = np.zeros_like(crops[scene.turn])
        crop[normal.eliminated.keyframes] = step[priors[n].free].reshape(2, -1).T
        crops[scene.turn] = crops[scene.turn] + crop
        moved = without_crops(scene, {scene.turn: crop})
        if shutter:
            moved = replace(moved, tracks=replace(
                moved.tracks, xy=moved.tracks.xy - step_s * shutter[n]))
        scenes.append(replace(moved, structure=normal.eliminated.moved(scene.structure, step)))
    nearer = camera.with_params(camera.params + part * moving.shared[:count])
    if nearer.covers_picture():
        camera = nearer
    step1 = type(camera).centred(camera.image_size, camera.fx, *now.step1.params[4:])
    fit = replace(fit, scenes=scenes, camera=camera, readout_s=fit.readout_s + step_s, crops=crops)
    return replace(now, step1=step1, fit=fit), strength
