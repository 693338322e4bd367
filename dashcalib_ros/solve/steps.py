"""The paper's two steps (3.2): all scenes are adjusted with one camera, and what they then know.

First one focal length and the distortion are free, then all parameters.
"""
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from dataclasses import field as default
from functools import cached_property

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.field import Field
from dashcalib_ros.config import Config
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.reconstruct.adjust import Solver, adjust
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.solve.field import FoundField
from dashcalib_ros.solve.fitting import (
    explained_by,
    retriangulate_all,
    with_better_poses,
    with_few_tracks,
    with_poses_of,
)
from dashcalib_ros.solve.fixed_camera import (
    Crops,
    FixedCameraTest,
    fixed_camera_tests,
    shift_prior,
)
from dashcalib_ros.solve.knowledge import Knowledge
from dashcalib_ros.solve.normal import Further, noise_in, turn_cost
from dashcalib_ros.solve.prior import bounds_of, floor_of, loss_px_of, prior_information, prior_of
from dashcalib_ros.solve.quadratic import Quadratic, noise_of
from dashcalib_ros.solve.shutter import readout, readout_parameter, remove_rolling_shutter

ByTurn = Mapping[TurnId, Scene]
Progress = Callable[[str, float], None]

# ratio: with one focal length the search goes this far to either side of the profile's minimum
FOCAL_REACH = 1.35
# a shorter readout, in its sigmas and in s, counts as a global shutter: six came out at 0 to 0.5
# ms
CLEAR_SIGMAS, LEAST_READOUT_S = 4.0, 1.0 / 1e3
# of what makes turns differ: most of it was the field that is taken out
LEFT_BY_FIELD = 0.5


@dataclass(frozen=True)
class Fit:
    """The state of the adjustment, and what the turns know there.

    centred: the camera that was found with one focal length, about which priors and bounds are.
    measured: each turn with all its tracks, a rolling shutter's effect still in them. readout_s:
    of the rolling shutter that was removed from the scenes' tracks. crops: of the stabilised
    video, as removed; empty for a fixed picture. field: what no lens model has, as removed; None
    where nothing speaks for one.
    """

    scenes: list[Scene]
    camera: Camera
    centred: Camera
    solver: Solver
    measured: ByTurn
    config: Config
    readout_s: float = 0.0
    crops: Crops = default(default_factory=dict)
    field: FoundField | None = None

    def adjusted(self, noise: float | None = None) -> Fit:
        """Return the fit with everything adjusted, within bounds and under priors.

        noise: variance of a residual for the priors, px^2; None: that of the fit.
        """
        scenes, camera = adjust(
            self.scenes, self.camera, self.solver, 'everything',
            prior=prior_of(self.centred, self.config.intrinsics,
                           self.noise if noise is None else noise),
            bounds=bounds_of(self.centred))
        return replace(self, scenes=scenes, camera=camera)

    def retriangulated(self) -> Fit:
        """Return the fit with its tracks triangulated anew; scenes without points are dropped."""
        return replace(self, scenes=retriangulate_all(self.scenes, self.camera, self.config.scene))

    def with_few_tracks(self) -> Fit:
        """Return the fit with a part of its tracks."""
        return replace(self, scenes=list(map(with_few_tracks, self.scenes)),
                       measured={turn: with_few_tracks(scene)
                                 for turn, scene in self.measured.items()})

    def as_measured(self) -> Fit:
        """Return the fit with the effect of a rolling shutter in its tracks."""
        scenes = [replace(scene, tracks=self.measured[scene.turn].tracks) for scene in self.scenes]
        return replace(self, scenes=scenes, readout_s=0.0)

    def with_usual_loss(self) -> Fit:
        """Return the fit with the loss that its residuals ask for."""
        loss_px = loss_px_of(self.scenes, self.camera, self.config.intrinsics)
        return replace(self, solver=replace(self.solver, loss_px=loss_px))

    @property
    def noise(self) -> float:
        """Return the variance of a residual for the priors, px^2."""
        inflation = self.field.inflation if self.field is not None else 1.0
        return inflation * noise_in(self.scenes, self.camera, self.solver.loss_px)

    @property
    def prior(self) -> Floats:
        """Return the prior's information (n, n) about the camera."""
        return prior_information(self.centred, self.config.intrinsics)

    @property
    def readout_left(self) -> tuple[float, float]:
        """Return the readout that is still in the tracks, and its sigma, s."""
        return readout(self.scenes, self.camera, self.solver.loss_px, self.prior)

    @property
    def used_field(self) -> Field | None:
        """Return the field that was taken out of the tracks, None without one."""
        return self.field.field if self.field is not None and self.field.used else None

    @cached_property
    def known(self) -> Knowledge:
        """Return what the turns know of the camera."""
        camera, loss_px = self.camera, self.solver.loss_px
        noise = noise_in(self.scenes, camera, loss_px) if self.crops else 0.0
        turns = tuple(turn_cost(
            scene, camera, loss_px, self._further,
            shift_prior(scene, noise, self.crops[scene.turn]) if self.crops
            else None) for scene in self.scenes)
        behind_field = self.used_field is not None
        left = LEFT_BY_FIELD if behind_field else 1.0
        return Knowledge(
            camera, turns, self._prior_of_all(), floor_of(camera, noise_of(turns)),
            turns_err_alike=behind_field,
            one_turn_sigma=left * self.config.intrinsics.one_turn_sigma * camera.fx)

    @property
    def _further(self) -> list[Further]:
        """Return what turns share beside the lens: the readout, the directions of the field."""
        return ([readout_parameter(self.camera)] * bool(self.readout_s)
                + ([] if self.field is None else [self.field.further(self.camera)]))

    def _prior_of_all(self) -> Quadratic:
        """Return the prior of the camera, of the readout, which has none, and of the field."""
        precision = np.concatenate([np.zeros(0), *(1 / np.square(each.sigmas)
                                                   for each in self._further)])
        at = np.zeros(len(self.prior) + len(precision))
        if self.field is not None:
            at[-self.field.basis.shape[1]:] = self.field.directions
        return Quadratic.prior(self.prior, precision,
                               -np.r_[np.zeros(len(self.prior)), precision] * at)

    def fixed_camera_tests(self, bent: bool = True) -> tuple[FixedCameraTest, ...]:
        """Return the tests whether the camera is a fixed one, the clearest that it is not first.

        bent: False leaves out the local bend, which takes longer.
        """
        return fixed_camera_tests(
            list(map(with_few_tracks, self.scenes)), self.camera, self.centred,
            self.solver.loss_px, self.config.intrinsics, self.crops, bent, bool(self.readout_s),
            self.field)


def fit_one_focal_length(measured: ByTurn, start: Camera, config: Config, progress: Progress
                         ) -> Fit:
    """Return the scenes adjusted with one focal length and distortion; the centre is fixed.

    A part of the tracks is enough to come near the result, and takes a third of the time.
    """
    settings = config.intrinsics
    solver = Solver(config.scene.loss_px, config.scene.iterations)
    reach = (start.fx / FOCAL_REACH, start.fx * FOCAL_REACH)
    few = list(map(with_few_tracks, measured.values()))
    camera = start
    for n in range(settings.rounds):
        progress('adjusting one focal length', n / settings.rounds)
        few, camera = adjust(few, camera, solver, 'one focal length', reach)
        few = retriangulate_all(few, camera, config.scene)
    kept = explained_by(few, measured, camera, config)
    return Fit(list(map(with_few_tracks, kept)), camera, camera, solver, measured, config)


def fit_roughly(first: Fit) -> Fit:
    """Return the scenes adjusted with all parameters, the effect of a rolling shutter removed.

    Without clear evidence of a rolling shutter the readout is 0: readouts of less than 1 ms were
    measured with global shutters.
    """
    settings, noise = first.config.intrinsics, first.noise
    fit = replace(first, measured={scene.turn: scene for scene in first.scenes}).adjusted(noise)
    for _ in range(settings.shutter_rounds):
        # the prior is about the camera of this round, not that of the first step
        found, sigma = readout(fit.scenes, fit.camera, fit.solver.loss_px,
                               prior_information(fit.camera, settings))
        if (abs(found) < sigma) if fit.readout_s else not is_rolling(found, sigma):
            break
        fit = _without_rolling_shutter(fit, fit.readout_s + found)
        fit = fit.adjusted(noise).retriangulated()
    return replace(fit, measured=first.measured)


def is_rolling(readout_s: float, sigma_s: float) -> bool:
    """Return whether a readout is clear evidence of a rolling shutter."""
    return abs(readout_s) >= max(CLEAR_SIGMAS * sigma_s, LEAST_READOUT_S)


def with_all_tracks(rough: Fit, per_turn: Sequence[Scene]) -> Fit:
    """Return the scenes with all their tracks, without those that the camera does not explain."""
    camera, config = rough.camera, rough.config
    scenes = [with_poses_of(rough.measured[scene.turn], scene) for scene in rough.scenes]
    if rough.readout_s:
        # the shutter's displacements depend on the points: find these with a generous limit first
        generous = replace(config.scene,
                           error_px=config.scene.chain_error * camera.image_size[0])
        scenes = retriangulate_all(scenes, camera, generous)
        scenes = _without_rolling_shutter(replace(rough, scenes=scenes), rough.readout_s).scenes
    else:
        scenes = retriangulate_all(scenes, camera, config.scene)
    scenes = explained_by(scenes, {scene.turn: scene for scene in scenes}, camera, config)
    return replace(rough, scenes=with_better_poses(scenes, per_turn, camera, config.scene))


def fit_all(complete: Fit, progress: Progress = lambda stage, done: None) -> Fit:
    """Return the scenes adjusted with all parameters, in rounds of triangulation."""
    settings, fit = complete.config.intrinsics, complete
    for n in range(settings.rounds):
        progress('adjusting all parameters', (n + 1) / (settings.rounds + 1))
        if n > 0:
            ready = _measured_again(fit)
            if not fit.readout_s and _changed(fit, ready) < settings.settled:
                break
            fit = ready
        fit = fit.with_usual_loss().adjusted()
    return fit


def _measured_again(fit: Fit) -> Fit:
    """Return the scenes triangulated anew, after the readout was measured once more."""
    if not fit.readout_s:
        return fit.retriangulated()
    return _without_rolling_shutter(fit, fit.readout_s + fit.readout_left[0])


def _without_rolling_shutter(fit: Fit, readout_s: float) -> Fit:
    """Return the scenes triangulated from tracks with the rolling shutter's effect removed."""
    moved = [remove_rolling_shutter(scene, fit.measured[scene.turn], fit.camera, readout_s)
             for scene in fit.scenes]
    return replace(fit, scenes=moved, readout_s=readout_s).retriangulated()


def _changed(before: Fit, after: Fit) -> float:
    """Return the share of the observations that are used in only one of the two."""
    used = {scene.turn: scene.structure.used for scene in after.scenes}
    if len(used) < len(before.scenes):
        return 1.0
    changed = sum(int(np.sum(scene.structure.used != used[scene.turn]))
                  for scene in before.scenes)
    return changed / sum(int(scene.structure.used.sum()) for scene in before.scenes)
