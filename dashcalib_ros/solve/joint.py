"""Scenes -> one camera, in the paper's two steps (3.2), and the information of each turn."""
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dashcalib_ros.camera import Camera
from dashcalib_ros.config import Config
from dashcalib_ros.reconstruction.adjust import Solver, adjust_step1, adjust_step2
from dashcalib_ros.reconstruction.scene import Profile, Scene
from dashcalib_ros.solve.fitting import (
    adapted_to,
    explained_by,
    retriangulate_all,
    subsample_tracks,
    with_better_poses,
    with_poses_of,
)
from dashcalib_ros.solve.focal import nearest_start, profile_around, summed
from dashcalib_ros.solve.information import covariance, information, noise_in
from dashcalib_ros.solve.misfit import misfits
from dashcalib_ros.solve.prior import (
    bounds_of,
    extra_sigma_of,
    loss_px_of,
    prior_information,
    prior_of,
)
from dashcalib_ros.solve.shutter import readout, remove_rolling_shutter, row_shift
from dashcalib_ros.solve.solution import Solution
from dashcalib_ros.turns.turn import TurnId

ByTurn = Mapping[TurnId, Scene]
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class _Fit:
    """The state of the adjustment. readout_s: of the rolling shutter that was removed."""

    scenes: list[Scene]
    camera: Camera
    solver: Solver
    readout_s: float = 0.0


def solve(separate: Sequence[Scene], config: Config,
          progress: Progress = lambda stage, done: None) -> Solution | None:
    """Adjust all scenes with one shared camera; None if the shared camera explains none of them.

    separate: at least one scene, each as its turn was reconstructed. The minimum of the summed
    focal profile is the start; a scene with a focal length far from it is chained anew, and one
    that the shared camera does not explain is dropped.
    """
    profile = summed([scene.profile for scene in separate])
    start = nearest_start(separate, profile)
    full_scenes = {scene.turn: adapted_to(scene, start, config) for scene in separate}
    first = _step1(full_scenes, start, config, progress)
    if not first.scenes:
        return None
    progress('step 2: all parameters', 0.0)
    rough = _step2_roughly(first, config)
    complete = _with_all_tracks(rough, full_scenes, separate, config)
    if not complete.scenes:
        return None
    final = _step2(complete, full_scenes, first.camera, config, progress)
    progress('focal profile', 0.0)
    around = profile_around(final.scenes, final.camera, profile, config)
    progress('sigma', 0.0)
    return _solution(final, first.camera, separate, (profile, around), config)


def _step1(full_scenes: ByTurn, start: Camera, config: Config, progress: Progress) -> _Fit:
    """Return the scenes adjusted with one focal length and distortion; the centre is held.

    A part of the tracks is enough to come near the result, and takes a third of the time.
    """
    settings = config.intrinsics
    solver = Solver(config.scene.loss_px, config.scene.iterations)
    reach = (start.fx / settings.focal_reach, start.fx * settings.focal_reach)
    few = [subsample_tracks(scene, settings.first_tracks) for scene in full_scenes.values()]
    camera = start
    for n in range(settings.rounds):
        progress('step 1: one focal length', n / settings.rounds)
        few, camera = adjust_step1(few, camera, solver, reach)
        few = retriangulate_all(few, camera, config.scene)
    kept = explained_by(few, full_scenes, camera, config)
    return _Fit([subsample_tracks(scene, settings.first_tracks) for scene in kept], camera, solver)


def _step2_roughly(first: _Fit, config: Config) -> _Fit:
    """Return the scenes adjusted with all parameters, the effect of a rolling shutter removed.

    Without clear evidence of a rolling shutter the readout is 0: readouts of less than 1 ms were
    measured with global shutters.
    """
    settings, solver = config.intrinsics, first.solver
    prior = prior_of(first.camera, settings, noise_in(first.scenes, first.camera, solver.loss_px))
    bounds = bounds_of(first.camera, settings)
    scenes, camera = adjust_step2(first.scenes, first.camera, solver, prior, bounds)
    measured = {scene.turn: scene for scene in scenes}
    total = 0.0
    for _ in range(settings.shutter_rounds):
        found, sigma = readout(scenes, camera, solver.loss_px, prior_information(camera, settings))
        if abs(found) < (sigma if total else max(settings.shutter_sigmas * sigma,
                                                 settings.least_readout_ms / 1e3)):
            break
        total += found
        scenes = _without_rolling_shutter(scenes, measured, camera, total, config)
        scenes, camera = adjust_step2(scenes, camera, solver, prior, bounds)
        scenes = retriangulate_all(scenes, camera, config.scene)
    return _Fit(scenes, camera, solver, total)


def _with_all_tracks(rough: _Fit, full_scenes: ByTurn, separate: Sequence[Scene], config: Config
                     ) -> _Fit:
    """Return the scenes with all their tracks, without those that the camera does not explain."""
    camera = rough.camera
    scenes = [with_poses_of(full_scenes[scene.turn], scene) for scene in rough.scenes]
    measured = {scene.turn: scene for scene in scenes}
    if rough.readout_s:
        # the shutter's displacements depend on the points: find these with a generous limit first
        generous = replace(config.scene,
                           error_px=config.scene.chain_error * camera.image_size[0])
        scenes = retriangulate_all(scenes, camera, generous)
        scenes = _without_rolling_shutter(scenes, measured, camera, rough.readout_s, config)
    else:
        scenes = retriangulate_all(scenes, camera, config.scene)
    scenes = explained_by(scenes, {scene.turn: scene for scene in scenes}, camera, config)
    return replace(rough, scenes=with_better_poses(scenes, separate, camera, config.scene))


def _step2(complete: _Fit, full_scenes: ByTurn, step1: Camera, config: Config, progress: Progress
           ) -> _Fit:
    """Return the scenes adjusted with all parameters, within bounds and priors from step 1."""
    settings = config.intrinsics
    fit, bounds = complete, bounds_of(step1, settings)
    for n in range(settings.rounds):
        progress('step 2: all parameters', (n + 1) / (settings.rounds + 1))
        if n > 0:
            ready = _retriangulated(fit, full_scenes, step1, config)
            if not fit.readout_s and _changed(fit, ready) < settings.settled:
                break
            fit = ready
        solver = replace(fit.solver, loss_px=loss_px_of(fit.scenes, fit.camera, settings))
        prior = prior_of(step1, settings, noise_in(fit.scenes, fit.camera, solver.loss_px))
        scenes, camera = adjust_step2(fit.scenes, fit.camera, solver, prior, bounds)
        fit = replace(fit, scenes=scenes, camera=camera, solver=solver)
    return fit


def _retriangulated(fit: _Fit, full_scenes: ByTurn, step1: Camera, config: Config) -> _Fit:
    """Return the scenes triangulated anew, after the readout was measured once more."""
    if not fit.readout_s:
        return replace(fit, scenes=retriangulate_all(fit.scenes, fit.camera, config.scene))
    prior = prior_information(step1, config.intrinsics)
    step_s, _ = readout(fit.scenes, fit.camera, fit.solver.loss_px, prior)
    readout_s = fit.readout_s + step_s
    scenes = _without_rolling_shutter(fit.scenes, full_scenes, fit.camera, readout_s, config)
    return replace(fit, scenes=scenes, readout_s=readout_s)


def _without_rolling_shutter(scenes: Sequence[Scene], measured: ByTurn, camera: Camera,
                             readout_s: float, config: Config) -> list[Scene]:
    """Return the scenes triangulated from tracks with the rolling shutter's effect removed."""
    moved = [remove_rolling_shutter(scene, measured[scene.turn], camera, readout_s)
             for scene in scenes]
    return retriangulate_all(moved, camera, config.scene)


def _changed(before: _Fit, after: _Fit) -> float:
    """Return the share of the observations that are used in only one of the two."""
    used = {scene.turn: scene.structure.used for scene in after.scenes}
    if len(used) < len(before.scenes):
        return 1.0
    changed = sum(int(np.sum(scene.structure.used != used[scene.turn]))
                  for scene in before.scenes)
    return changed / sum(int(scene.structure.used.sum()) for scene in before.scenes)


def _solution(final: _Fit, step1: Camera, separate: Sequence[Scene],
           profiles: tuple[Profile, Profile], config: Config) -> Solution:
    """Return the solution with its covariance. profiles: the coarse one, and that around it."""
    settings = config.intrinsics
    scenes, camera, readout_s = final.scenes, final.camera, final.readout_s
    parts = tuple(information(scene, camera, final.solver.loss_px,
                              row_shift(scene, camera) if readout_s else None)
                  for scene in scenes)
    prior = prior_information(step1, settings)
    count = len(prior)
    spread = covariance(parts, prior, extra_sigma_of(camera))
    floor = np.zeros(count)
    floor[:2] = settings.focal_floor * camera.fx
    floor[2:4] = settings.centre_floor * camera.image_size[0]
    return Solution(
        camera=camera, covariance=spread[:count, :count] + np.diag(floor**2), step1=step1,
        scenes=tuple(scenes), parts=parts, coarse=profiles[0], around=profiles[1],
        bounds=np.array(bounds_of(step1, settings)), prior_information=prior, readout_s=readout_s,
        readout_sigma_s=float(np.sqrt(spread[count, count])) if readout_s else 0.0,
        misfits=misfits(separate, scenes, camera, config.scene.error_px))
