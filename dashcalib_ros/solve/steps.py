"""The paper's two steps (3.2): all scenes are adjusted with one camera, and what they then say."""
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from dataclasses import field as default
from functools import cached_property

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.field import Field
from dashcalib_ros.config import Config, IntrinsicsConfig
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.reconstruct.adjust import Solver, adjust_step1, adjust_step2
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.solve.departures import Crops, Departure, departures, shift_prior
from dashcalib_ros.solve.field import FoundField
from dashcalib_ros.solve.fitting import (
    explained_by,
    retriangulate_all,
    subsample_tracks,
    with_better_poses,
    with_poses_of,
)
from dashcalib_ros.solve.information import Information, information, noise_in, step_to_wider_model
from dashcalib_ros.solve.picture import SigmaMap, sigma_map
from dashcalib_ros.solve.prior import (
    bounds_of,
    extra_sigma_of,
    floor_of,
    loss_px_of,
    prior_information,
    prior_of,
)
from dashcalib_ros.solve.shutter import readout, remove_rolling_shutter, row_shift

ByTurn = Mapping[TurnId, Scene]
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Fit:
    """The state of the adjustment. readout_s: of the rolling shutter that was removed.

    crops: of the stabilised video, as removed; empty for a fixed picture. field: what no lens
    model has, as removed; None where nothing speaks for one.
    """

    scenes: list[Scene]
    camera: Camera
    solver: Solver
    readout_s: float = 0.0
    crops: Crops = default(default_factory=dict)
    field: FoundField | None = None

    def noise(self, loss_px: float) -> float:
        """Return the variance of a residual for the priors, px^2; loss_px: of the Cauchy loss."""
        inflation = self.field.inflation if self.field is not None else 1.0
        return inflation * noise_in(self.scenes, self.camera, loss_px)


@dataclass(frozen=True)
class Result:
    """A fit at its end, and what the priors come from."""

    fit: Fit
    step1: Camera
    settings: IntrinsicsConfig

    @cached_property
    def parts(self) -> tuple[Information, ...]:
        """Return what each turn says of the lens."""
        fit, loss_px = self.fit, self.fit.solver.loss_px
        noise = noise_in(fit.scenes, fit.camera, loss_px) if fit.crops else 0.0
        return tuple(information(
            scene, fit.camera, loss_px, *self._extras(scene),
            shift_prior(scene, noise, self.settings, fit.crops[scene.turn]) if fit.crops else None)
            for scene in fit.scenes)

    def _extras(self, scene: Scene) -> tuple[Floats | None, tuple[Floats, Floats]]:
        """Return a scene's derivatives by what all turns share beside the lens, and its prior.

        (k, t, 2, e) for the readout of a rolling shutter and the directions of the field, and
        (e,) the information and the negative gradient of their priors.
        """
        fit, columns, prior, pull = self.fit, [], [np.zeros(0)], [np.zeros(0)]
        if fit.readout_s:
            columns.append(row_shift(scene, fit.camera)[..., None])
            prior.append(np.zeros(1))
            pull.append(np.zeros(1))
        if fit.field is not None:
            columns.append(fit.field.columns(scene, fit.camera))
            prior.append(np.full(columns[-1].shape[-1], fit.field.sigma_px**-2.0))
            pull.append(-prior[-1] * fit.field.directions)
        return (np.concatenate(columns, axis=-1) if columns else None,
                (np.concatenate(prior), np.concatenate(pull)))

    @cached_property
    def prior(self) -> Floats:
        """Return the prior's information (n, n) about the camera."""
        return prior_information(self.step1, self.settings)

    def departures(self, bent: bool = True) -> tuple[Departure, ...]:
        """Return how the drive departs from a fixed camera, the strongest first."""
        fit = self.fit
        scenes = [subsample_tracks(scene, self.settings.first_tracks) for scene in fit.scenes]
        return departures(scenes, fit.camera, self.step1, fit.solver.loss_px, self.settings,
                          fit.crops, bent, bool(fit.readout_s), fit.field)

    @property
    def floor(self) -> Floats:
        """Return the sigmas (n,) of systematic errors."""
        return floor_of(self.fit.camera, self.settings, self.used_field)

    @property
    def one_turn_sigma(self) -> float:
        """Return by how much fx differs between single turns, px."""
        return self.settings.one_turn_sigma * self.fit.camera.fx

    @property
    def used_field(self) -> Field | None:
        """Return the field that was taken out of the tracks, None without one."""
        found = self.fit.field
        return found.field if found is not None and found.used else None

    def sigma_map(self, systematic: float = 1.0) -> SigmaMap:
        """Return the sigma over the picture; systematic: as for picture_covariance()."""
        camera = self.fit.camera
        return sigma_map(
            camera, self.parts, self.prior, self.floor,
            step_to_wider_model(self.parts, self.prior, extra_sigma_of(camera)), systematic,
            self.one_turn_sigma, self.used_field)


def step1(full_scenes: ByTurn, start: Camera, config: Config, progress: Progress) -> Fit:
    """Return the scenes adjusted with one focal length and distortion; the centre is held.

    A part of the tracks is enough to come near the result, and takes a third of the time.
    """
    settings = config.intrinsics
    solver = Solver(config.scene.loss_px, config.scene.iterations)
    reach = (start.fx / settings.focal_reach, start.fx * settings.focal_reach)
    few = [subsample_tracks(scene, settings.first_tracks) for scene in full_scenes.values()]
    camera = start
    for n in range(settings.rounds):
        progress('adjusting one focal length', n / settings.rounds)
        few, camera = adjust_step1(few, camera, solver, reach)
        few = retriangulate_all(few, camera, config.scene)
    kept = explained_by(few, full_scenes, camera, config)
    return Fit([subsample_tracks(scene, settings.first_tracks) for scene in kept], camera, solver)


def step2_roughly(first: Fit, config: Config) -> Fit:
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
        if (abs(found) < sigma) if total else not is_rolling(found, sigma, settings):
            break
        total += found
        scenes = _without_rolling_shutter(scenes, measured, camera, total, config)
        scenes, camera = adjust_step2(scenes, camera, solver, prior, bounds)
        scenes = retriangulate_all(scenes, camera, config.scene)
    return Fit(scenes, camera, solver, total)


def is_rolling(readout_s: float, sigma_s: float, config: IntrinsicsConfig) -> bool:
    """Return whether a readout is clear evidence of a rolling shutter."""
    return abs(readout_s) >= max(config.shutter_sigmas * sigma_s, config.least_readout_ms / 1e3)


def with_all_tracks(rough: Fit, full_scenes: ByTurn, separate: Sequence[Scene], config: Config
                    ) -> Fit:
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


def step2(complete: Fit, full_scenes: ByTurn, step1: Camera, config: Config,
           progress: Progress = lambda stage, done: None) -> Fit:
    """Return the scenes adjusted with all parameters, within bounds and priors from step 1."""
    settings = config.intrinsics
    fit, bounds = complete, bounds_of(step1, settings)
    for n in range(settings.rounds):
        progress('adjusting all parameters', (n + 1) / (settings.rounds + 1))
        if n > 0:
            ready = _retriangulated(fit, full_scenes, step1, config)
            if not fit.readout_s and _changed(fit, ready) < settings.settled:
                break
            fit = ready
        solver = replace(fit.solver, loss_px=loss_px_of(fit.scenes, fit.camera, settings))
        prior = prior_of(step1, settings, fit.noise(solver.loss_px))
        scenes, camera = adjust_step2(fit.scenes, fit.camera, solver, prior, bounds)
        fit = replace(fit, scenes=scenes, camera=camera, solver=solver)
    return fit


def _retriangulated(fit: Fit, full_scenes: ByTurn, step1: Camera, config: Config) -> Fit:
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


def _changed(before: Fit, after: Fit) -> float:
    """Return the share of the observations that are used in only one of the two."""
    used = {scene.turn: scene.structure.used for scene in after.scenes}
    if len(used) < len(before.scenes):
        return 1.0
    changed = sum(int(np.sum(scene.structure.used != used[scene.turn]))
                  for scene in before.scenes)
    return changed / sum(int(scene.structure.used.sum()) for scene in before.scenes)
