"""A stabilised video: how far its crop moved in each image is found and taken out of the tracks.

A stabiliser moves the crop against the car's turning, so that the principal point moves through
the picture. That looks much like a rotation, and makes focal lengths wrong by up to 20 %. What
tells them apart is the lens: its distortion moves with the crop, and a rotation moves the rim of
the picture farther than its middle. So the shift of each image is a parameter of the solution; the
tracks are moved to where a fixed crop would have seen them, and all is adjusted again.
"""
from __future__ import annotations

from dataclasses import replace

import numpy as np

from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.solve.fixed_camera import READOUT_S, Crops, Problem, problem_of, shift_priors
from dashcalib_ros.solve.normal import IMAGE
from dashcalib_ros.solve.shutter import readout_parameter, row_shift
from dashcalib_ros.solve.steps import Fit

# of the width; the longest step of a shift in one round
LONGEST_STEP = 0.04
# times what chance gains; a step that gains less is the last one
SETTLED = 2.0


def without_crops(scene: Scene, crops: Crops) -> Scene:
    """Return the scene with the tracks that a fixed crop would have given."""
    moved = scene.tracks.xy - crops[scene.turn][:, None]
    return replace(scene, tracks=replace(scene.tracks, xy=moved))


def without_stabiliser(given: Fit, rounds: int) -> Fit:
    """Return the fit with the movement of the crop taken out, in so many rounds at the most.

    The same fit if a turn is lost. A rolling shutter that was taken out before is estimated anew
    together with the crop.
    """
    crops = given.crops or {scene.turn: np.zeros((len(scene.tracks.frames), 2))
                            for scene in given.scenes}
    now = replace(given, crops=crops)
    for _ in range(rounds):
        now = now.with_usual_loss()
        problem = problem_of(
            now.scenes, now.camera, now.centred, now.solver.loss_px, now.config.intrinsics,
            [readout_parameter(now.camera, READOUT_S)] * bool(now.readout_s))
        now, strength = _step(now, problem)
        now = now.adjusted(problem.noise).retriangulated()
        if len(now.scenes) < len(given.scenes):
            return given
        if strength < SETTLED:
            break
    return now.with_usual_loss()


def _step(fit: Fit, problem: Problem) -> tuple[Fit, float]:
    """Return what one Gauss-Newton step makes of the fit, and how clear the step is."""
    camera, rolling = fit.camera, bool(fit.readout_s)
    count, lens = problem.own, len(camera.widened().names())
    shared = range(count, lens + rolling)
    priors = shift_priors(problem, fit.crops)
    moving = problem.solved(priors, shared)
    strength = moving.strength(problem.solved(None, shared))
    moving = problem.solved(priors, shared, max(strength, 1.0))
    longest = float(np.abs(np.concatenate(moving.images)).max())
    part = min(1.0, LONGEST_STEP * camera.image_size[0] / max(longest, 1e-9))
    step_s = part * float(moving.shared[-1]) if rolling else 0.0
    scenes, crops = [], dict(fit.crops)
    for n, (scene, normal) in enumerate(zip(fit.scenes, problem.normals, strict=True)):
        step = np.zeros(len(normal.cost.score))
        step[priors[n].free] = part * moving.images[n]
        step[IMAGE * normal.images:IMAGE * normal.images + count] = part * moving.shared[:count]
        crop = np.zeros_like(crops[scene.turn])
        crop[normal.eliminated.keyframes] = step[priors[n].free].reshape(2, -1).T
        crops[scene.turn] = crops[scene.turn] + crop
        moved = without_crops(scene, {scene.turn: crop})
        if rolling:
            moved = replace(moved, tracks=replace(
                moved.tracks, xy=moved.tracks.xy - step_s * row_shift(scene, camera)))
        scenes.append(replace(moved, structure=normal.eliminated.moved(scene.structure, step)))
    nearer = camera.with_params(camera.params + part * moving.shared[:count])
    if nearer.covers_picture():
        camera = nearer
    centred = type(camera).centred(camera.image_size, camera.fx, *fit.centred.params[4:])
    return replace(fit, scenes=scenes, camera=camera, centred=centred,
                   readout_s=fit.readout_s + step_s, crops=crops), strength
