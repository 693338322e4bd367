# SPDX-License-Identifier: Apache-2.0
"""What the optimum says: the camera to write, how far it may be off, and what is named."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from dataclasses import field as default

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.field import Field
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.problem.blocks import Drift, lens_alone, middle
from dashcalib_ros.problem.quadratic import NONE, Quadratic
from dashcalib_ros.problem.stamps import Times
from dashcalib_ros.reconstruct.scene import Profile, Scene, rms_px
from dashcalib_ros.solve.evidence import Candidate, FixedCameraTest
from dashcalib_ros.solve.spread import PictureSigma, Posterior, SigmaMap, sigma_over
from dashcalib_ros.solve.written import Written, written

# fewer turns are not left out: one of two says little of the other
LEAST_TURNS = 3


@dataclass(frozen=True)
class FocalDrift:
    """By how much the focal length grows from the first turn's begin to the last one's end, of 1.

    With its sigma. ways: in which it grows, as found; covariance: (c, c) of them.
    """

    size: float
    sigma: float
    ways: Drift
    covariance: Floats

    @classmethod
    def of(cls, ways: Drift, covariance: Floats) -> FocalDrift:
        """Return what these ways add up to. covariance: of what turns share, ways' at its end."""
        grows = np.diff(ways.grown_at(np.array([ways.begin_ns, ways.end_ns])), axis=0)[0]
        own = covariance[-len(grows):, -len(grows):]
        return cls(float(grows @ ways.value), float(np.sqrt(grows @ own @ grows)), ways, own)

    def moved(self, step: Floats, covariance: Floats) -> FocalDrift:
        """Return it after a step (m,) of what turns share, with the covariance then."""
        value = self.ways.value
        return self.of(replace(self.ways, value=value + step[-len(value):]), covariance)

    @property
    def largest(self) -> float:
        """Return the largest difference between two times of the drive, of 1."""
        ways = self.ways
        steps_ns = np.array(ways.steps_ns, np.int64)
        times_ns = np.r_[ways.begin_ns, steps_ns - 1, steps_ns, ways.end_ns]
        if ways.warmth is not None:
            inner_ns = np.round(1e9 * ways.warmth.samples.stamps_s).astype(np.int64)
            times_ns = np.r_[times_ns, inner_ns[
                (inner_ns > ways.begin_ns) & (inner_ns < ways.end_ns)]]
        grown = ways.grown_at(times_ns)
        return float(np.ptp(grown @ self.ways.value))

    @property
    def seconds(self) -> float:
        """Return the time from the first turn's begin to the last one's end."""
        return (self.ways.end_ns - self.ways.begin_ns) / 1e9

    @property
    def step_ns(self) -> int | None:
        """Return when it steps; None where it does anything else."""
        ways = self.ways
        return None if ways.steady or ways.warmth is not None else ways.steps_ns[0]

    @property
    def linear(self) -> bool:
        """Return whether it grows steadily, or with the temperature, and nothing else."""
        return not self.ways.steps_ns

    @property
    def of_kelvin(self) -> tuple[float, float] | None:
        """Return by how much of 1 it grows with each kelvin, and its sigma; None: with time."""
        warmth = self.ways.warmth
        if warmth is None or not self.linear:
            return None
        sigma = float(np.sqrt(self.covariance[0, 0]))
        return float(self.ways.value[0]) / warmth.span_k, sigma / warmth.span_k


@dataclass(frozen=True)
class Solution:
    """All turns adjusted together.

    written: the camera that is written, and the field beside it; posterior: what all turns know
    about the lens, the readout and the field, in the order of scenes. scenes: as adjusted, as the
    written camera alone would have seen them, in the order given. centred: the camera with one
    focal length that was found first, about which priors and bounds are; bounds: (2, n) lowest and
    highest values that were allowed. coarse: the sum of the turns' focal profiles; around: the
    profile near the result, of all bends. readout_s: from the first row to the last, negative
    where the last comes first; its standard deviation is readout_sigma_s. misfits: of every turn
    that was given: the ratio of its cost with this camera to its cost with its own camera. tried:
    the kinds of lenses that were compared. fixed_camera: the tests whether it is one, the clearest
    that it is not first. crops: by turn (k, 2) px, how far a stabiliser moved each keyframe's
    picture; empty for a fixed picture. perhaps_shifted: turns so gentle that a stabiliser might
    have shifted their pictures: each may be, and sigma contains it. fixed: it is known that there
    is no stabiliser, and the pictures do not move. drift: of the focal length, which is that of
    the middle of the drive then; parts: of a step, the solutions of the turns before it and of
    those later. unsettled: how far the last step moved the rays over the picture, in their sigma.
    field_sigma: px, of the prior of the field's directions. by_pictures: the solution of the
    pictures alone, where a gyro's angles are in this one; by_turns: the one before what somebody
    knew about the camera was used. px: of the input's pictures, in one pixel of the scenes. times:
    what the stamps of the scenes as given do not say.
    """

    written: Written
    posterior: Posterior
    centred: Camera
    scenes: tuple[Scene, ...]
    coarse: Profile
    around: Profile
    bounds: Floats
    readout_s: float = 0.0
    readout_sigma_s: float = 0.0
    misfits: Mapping[TurnId, float] = default(default_factory=dict)
    tried: tuple[Candidate, ...] = ()
    fixed_camera: tuple[FixedCameraTest, ...] = ()
    crops: Mapping[TurnId, Floats] = default(default_factory=dict)
    perhaps_shifted: frozenset[TurnId] = frozenset()
    fixed: bool = False
    drift: FocalDrift | None = None
    parts: tuple[Solution | None, ...] = ()
    unsettled: float = 0.0
    field_sigma: float = 0.0
    by_pictures: Solution | None = None
    by_turns: Solution | None = None
    px: float = 1.0
    times: Times = default(default_factory=Times)

    @property
    def camera(self) -> Camera:
        """Return the written camera, with n parameters."""
        return self.written.camera

    @property
    def field(self) -> Field | None:
        """Return the field beside the camera; None where it is nothing."""
        return self.written.field

    def carried(self, covariance: Floats) -> Floats:
        """Return the covariance (n, n) of the camera from one (m, m) of what turns share."""
        follow = self.written.by_solution
        return np.asarray(follow @ covariance @ follow.T + self.written.loose)

    @property
    def covariance(self) -> Floats:
        """Return the covariance (n, n) of the camera's parameters."""
        return self.carried(self.posterior.covariance)

    def at(self, stamp_ns: int) -> tuple[Camera, Floats]:
        """Return the camera at a time of the drive, and its n standard deviations (n,)."""
        camera, count = self.camera, len(self.camera.params)
        if self.drift is None:
            return camera, self.sigma
        ways = self.drift.ways
        grown = ways.grown_at(np.array([stamp_ns]))[0]
        zoom = 1 + float(grown @ ways.value)
        times = np.where(np.arange(count) < 4, zoom, 1.0)
        still = np.r_[0.0, 0.0, middle(camera.image_size), np.zeros(count - 4)]
        moves = np.where(np.arange(count) < 4, camera.params - still, 0.0)
        follow = times[:, None] * self.written.by_solution
        follow[:, follow.shape[1] - len(grown):] += np.outer(moves, grown)
        covariance = follow @ self.posterior.covariance @ follow.T + self.written.loose
        return camera.zoomed(zoom), np.sqrt(np.diag(covariance))

    @property
    def wide_covariance(self) -> Floats:
        """Return the covariance (w, w) of the parameters of the widest model of this kind.

        The camera's own come first. What the others would be counts as an error.
        """
        follow, left = self.written.wide_by_solution, self.written.wide_left
        return np.asarray(follow @ self.posterior.covariance @ follow.T + np.outer(left, left))

    @property
    def sigma(self) -> Floats:
        """Return the n standard deviations (n,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def sigma_map(self) -> SigmaMap:
        """Return how far camera_info may be off over the picture, the field that it lacks too."""
        return self.written.sigma_map(self.posterior.covariance)

    @property
    def picture(self) -> PictureSigma:
        """Return the sigma of camera_info over the picture."""
        return self.sigma_map.whole

    @property
    def rays_sigma_px(self) -> float:
        """Return how far rays with the camera and the field may be off, RMS over the picture."""
        return self.written.sigma_map(self.posterior.covariance, with_field=True).whole.rms

    @property
    def rolling(self) -> bool:
        """Return whether there is clear evidence of a rolling shutter, and it matters."""
        clear = CLEAR_SIGMAS if len(self.scenes) > 1 else CLEAR_ALONE
        return abs(self.readout_s) >= max(clear * self.readout_sigma_s, NAMED_READOUT_S)

    @property
    def reprojection_error_px(self) -> float:
        """Return the root mean square reprojection error of the used observations, px."""
        return rms_px(self.scenes, self.camera)

    def offset_of(self, some: Posterior) -> Floats:
        """Return (n,) how far the camera of some of the turns is off that of them all."""
        return np.asarray(self.written.by_solution @ (some.offset - self.posterior.offset))

    def seen_by_turns(self, given: Camera) -> Floats:
        """Return (n,) the parameters of this model that turns find where given is true.

        given: of this model, or of its wider one: then it is the one that would be written of it.
        """
        if len(given.params) == len(self.camera.params):
            return given.params
        return written(lens_alone(given), NONE, self.scenes, self.camera.model).camera.params


# a readout that is shorter, in its sigmas, or its sigmas where there is one turn, and in s, is not
# named: traffic and the sun on a ramp made -6.7 ± 1.2 ms of a global shutter
CLEAR_SIGMAS, CLEAR_ALONE, NAMED_READOUT_S = 4.0, 8.0, 1e-3


@dataclass(frozen=True)
class LeftOut:
    """A turn, and the calibration that was made without it.

    px: RMS over the picture of the difference between the camera of the other turns and the one
    of this turn alone, the best common rotation removed. sigma_px: of the camera of this turn
    alone; others_sigma_px: of the camera of the others. Good calibrations differ by less than the
    sum of both (mrcal's cross-validation). All are px of the pictures that were solved.
    """

    turn: TurnId
    px: float
    sigma_px: float
    others_sigma_px: float

    def times(self, px: float) -> LeftOut:
        """Return the same in pixels that are px times smaller."""
        return LeftOut(self.turn, px * self.px, px * self.sigma_px, px * self.others_sigma_px)

    @property
    def sigmas(self) -> float:
        """Return the difference in units of its own standard deviation."""
        return self.px / float(np.hypot(self.sigma_px, self.others_sigma_px))


def cross_validation(solution: Solution) -> tuple[LeftOut, ...]:
    """Return what each turn says about the calibration without it; () for fewer than three turns.

    Neither camera needs a new adjustment. That turns may differ is left out of sigma: it is what
    is asked here.
    """
    known, moves = solution.posterior.alike, solution.written.moves
    if len(known.turns) < LEAST_TURNS:
        return ()
    found = []
    for n, scene in enumerate(solution.scenes):
        alone, others = known.of([n]), known.without(n)
        apart = moves @ (alone.offset - others.offset)
        found.append(LeftOut(
            scene.turn, _rms(np.linalg.norm(apart, axis=1)),
            *(_rms(sigma_over(moves, some.covariance)) for some in (alone, others))))
    return tuple(found)


def with_measurement(solution: Solution, along: Floats, apart: float, variance: float
                     ) -> Solution:
    """Return the solution with one more measurement of what turns share, linearised.

    along: (m,) its derivatives; apart: what it says, less what the solution says; variance: its
    own. Only the camera and what is known about it move: the turns stay as they are.
    """
    known = solution.posterior
    # scores are about the optimum, and the solution stands for the mean, which is off it
    further = Quadratic(np.outer(along, along) / variance,
                        along * (apart + along @ known.offset) / variance,
                        np.zeros((len(along), len(along))))
    moved = replace(known, further=(*known.further, further))
    step, place = moved.offset - known.offset, len(known.lens.params)
    return replace(
        solution, posterior=moved,
        drift=solution.drift and solution.drift.moved(step, moved.covariance),
        readout_s=solution.readout_s + float(step[place]),
        readout_sigma_s=float(np.sqrt(moved.covariance[place, place])),
        written=replace(solution.written, camera=solution.camera.with_params(
            solution.camera.params + solution.written.by_solution @ step)))


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))
