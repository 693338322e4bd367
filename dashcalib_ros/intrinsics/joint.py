"""Scenes -> one camera, in the paper's two steps (3.2), with what each turn knows of it."""
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from dashcalib_ros.config import IntrinsicsConfig, SceneConfig
from dashcalib_ros.intrinsics.agreement import misfits
from dashcalib_ros.intrinsics.belief import belief_of, bounds_of, loss_px_of, prior_of
from dashcalib_ros.intrinsics.fitting import (
    all_again,
    brought_to,
    every,
    explained_by,
    mended,
    posed_as,
)
from dashcalib_ros.intrinsics.focal import nearest_start, profile_around, summed
from dashcalib_ros.intrinsics.information import covariance, information, noise_in
from dashcalib_ros.intrinsics.shutter import readout, row_shift, undone
from dashcalib_ros.intrinsics.solution import Solution
from dashcalib_ros.reconstruction.adjust import Solver, adjust_step1, adjust_step2
from dashcalib_ros.reconstruction.camera import Camera
from dashcalib_ros.reconstruction.scene import Profile, Scene

Array = npt.NDArray[np.float64]
Whole = Mapping[int, Scene]
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class _Fit:
    """Scenes as far as they are adjusted. readout_s: of a rolling shutter that was undone."""

    scenes: list[Scene]
    camera: Camera
    solver: Solver
    readout_s: float = 0.0


def solve(alone: Sequence[Scene], config: IntrinsicsConfig, scene_config: SceneConfig,
          seed: int = 0, progress: Progress = lambda stage, done: None) -> Solution | None:
    """Adjust all scenes with one shared camera.

    alone: at least one scene, each as its turn was reconstructed. The summed focal profile picks
    the start; a scene that was built far from it is chained anew, and one that the shared camera
    does not explain is dropped. None when that becomes of all.
    """
    profile = summed([scene.profile for scene in alone])
    start = nearest_start(alone, profile)
    whole = {scene.center: brought_to(scene, start, scene_config, seed) for scene in alone}
    first = _step1(whole, start, config, scene_config, seed, progress)
    if not first.scenes:
        return None
    progress('step 2: all six', 0.0)
    rough = _step2_roughly(first, config, scene_config)
    complete = _with_all_tracks(rough, whole, alone, scene_config, seed)
    if not complete.scenes:
        return None
    final = _step2(complete, whole, first.camera, config, scene_config, progress)
    progress('focal profile', 0.0)
    around = profile_around(final.scenes, final.camera, profile, config, scene_config, seed)
    progress('sigma', 0.0)
    return _known(final, first.camera, alone, (profile, around), config, scene_config)


def _step1(whole: Whole, start: Camera, config: IntrinsicsConfig, scene_config: SceneConfig,
           seed: int, progress: Progress) -> _Fit:
    """Return the scenes with one focal length, k1 and k2; the centre in the middle.

    A part of the tracks is enough to come near the result, at a third of the time.
    """
    solver = Solver(scene_config.loss_px, scene_config.iterations)
    reach = (start.fx / config.focal_reach, start.fx * config.focal_reach)
    few, camera = [every(scene, config.first_tracks) for scene in whole.values()], start
    for n in range(config.rounds):
        progress('step 1: one focal length', n / config.rounds)
        few, camera = adjust_step1(few, camera, solver, reach)
        few = all_again(few, camera, scene_config)
    kept = explained_by(few, whole, camera, scene_config, seed)
    return _Fit([every(scene, config.first_tracks) for scene in kept], camera, solver)


def _step2_roughly(first: _Fit, config: IntrinsicsConfig, scene_config: SceneConfig) -> _Fit:
    """Return the scenes as a global shutter would have seen them, with all six.

    Without clear evidence of a rolling shutter they are as they were, and the readout 0: the
    global shutters at hand were measured within 1 ms of that.
    """
    solver = first.solver
    prior = prior_of(first.camera, config, noise_in(first.scenes, first.camera, solver.loss_px))
    bounds = bounds_of(first.camera, config)
    scenes, camera = adjust_step2(first.scenes, first.camera, solver, prior, bounds)
    measured = {scene.center: scene for scene in scenes}
    total = 0.0
    for _ in range(config.shutter_rounds):
        found, sigma = readout(scenes, camera, solver.loss_px, belief_of(camera, config))
        if abs(found) < (sigma if total else max(config.shutter_sigmas * sigma,
                                                 config.least_readout_ms / 1e3)):
            break
        total += found
        scenes = all_again(_undone(scenes, measured, camera, total), camera, scene_config)
        scenes, camera = adjust_step2(scenes, camera, solver, prior, bounds)
        scenes = all_again(scenes, camera, scene_config)
    return _Fit(scenes, camera, solver, total)


def _with_all_tracks(rough: _Fit, whole: Whole, alone: Sequence[Scene], config: SceneConfig,
                     seed: int) -> _Fit:
    """Return the scenes with all their tracks, those that the camera explains."""
    camera = rough.camera
    scenes = _without_shutter([posed_as(whole[scene.center], scene) for scene in rough.scenes],
                              camera, rough.readout_s, config)
    scenes = explained_by(scenes, {scene.center: scene for scene in scenes}, camera, config, seed)
    return replace(rough, scenes=mended(scenes, alone, camera, config))


def _step2(complete: _Fit, whole: Whole, step1: Camera, config: IntrinsicsConfig,
           scene_config: SceneConfig, progress: Progress) -> _Fit:
    """Return the scenes adjusted with all six, within bounds and priors from step 1."""
    fit, bounds = complete, bounds_of(step1, config)
    for n in range(config.rounds):
        progress('step 2: all six', (n + 1) / (config.rounds + 1))
        if n > 0:
            ready = _ready_again(fit, whole, step1, config, scene_config)
            if not fit.readout_s and _changed(fit, ready) < config.settled:
                break
            fit = ready
        solver = replace(fit.solver, loss_px=loss_px_of(fit.scenes, fit.camera, config))
        prior = prior_of(step1, config, noise_in(fit.scenes, fit.camera, solver.loss_px))
        scenes, camera = adjust_step2(fit.scenes, fit.camera, solver, prior, bounds)
        fit = replace(fit, scenes=scenes, camera=camera, solver=solver)
    return fit


def _ready_again(fit: _Fit, whole: Whole, step1: Camera, config: IntrinsicsConfig,
                 scene_config: SceneConfig) -> _Fit:
    """Return the scenes triangulated anew, the readout measured once more."""
    scenes, readout_s = fit.scenes, fit.readout_s
    if readout_s:
        readout_s += readout(scenes, fit.camera, fit.solver.loss_px, belief_of(step1, config))[0]
        scenes = _undone(scenes, whole, fit.camera, readout_s)
    return replace(fit, scenes=all_again(scenes, fit.camera, scene_config), readout_s=readout_s)


def _changed(before: _Fit, after: _Fit) -> float:
    """Return the share of the observations that are used in one of the two only."""
    used = {scene.center: scene.structure.used for scene in after.scenes}
    if len(used) < len(before.scenes):
        return 1.0
    changed = sum(int(np.sum(scene.structure.used != used[scene.center]))
                  for scene in before.scenes)
    return changed / sum(int(scene.structure.used.sum()) for scene in before.scenes)


def _known(final: _Fit, step1: Camera, alone: Sequence[Scene],
           profiles: tuple[Profile, Profile], config: IntrinsicsConfig,
           scene_config: SceneConfig) -> Solution:
    """Return the solution with what its turns know. profiles: the coarse one, that around it."""
    scenes, camera, readout_s = final.scenes, final.camera, final.readout_s
    parts = tuple(information(scene, camera, final.solver.loss_px,
                              row_shift(scene, camera) if readout_s else None)
                  for scene in scenes)
    belief = belief_of(step1, config)
    spread = covariance(parts, belief)
    readout_sigma_s = float(np.sqrt(spread[6, 6])) if readout_s else 0.0
    floor = np.diag(np.square([config.focal_floor * camera.fx] * 2
                              + [config.centre_floor * camera.image_size[0]] * 2 + [0.0] * 2))
    return Solution(camera, spread[:6, :6] + floor, step1, tuple(scenes), parts, *profiles,
                    np.array(bounds_of(step1, config)), belief, readout_s, readout_sigma_s,
                    misfits(alone, scenes, camera, scene_config.error_px))


def _without_shutter(scenes: Sequence[Scene], camera: Camera, readout_s: float,
                     config: SceneConfig) -> list[Scene]:
    """Return scenes that have poses triangulated, where a rolling shutter left its marks, too."""
    if not readout_s:
        return all_again(scenes, camera, config)
    # until the points are known, nobody knows how far the shutter has displaced them
    generous = replace(config, error_px=config.chain_error * camera.image_size[0])
    rough = all_again(scenes, camera, generous)
    return all_again(_undone(rough, {scene.center: scene for scene in scenes}, camera, readout_s),
                     camera, config)


def _undone(scenes: Sequence[Scene], measured: Whole, camera: Camera, readout_s: float
            ) -> list[Scene]:
    return [undone(scene, measured[scene.center], camera, readout_s) for scene in scenes]
