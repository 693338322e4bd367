# SPDX-License-Identifier: Apache-2.0
"""The result of a calibration: a camera, a sigma for each parameter, a verdict with reasons."""
from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from dataclasses import field as default
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from dashcalib_ros.arrays import Floats, Mask
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.field import Field
from dashcalib_ros.camera.mapping import sensitivity
from dashcalib_ros.camera.remap import rectify
from dashcalib_ros.camera.rotation import OPTICAL, quaternion, rotation_matrices
from dashcalib_ros.config import Config
from dashcalib_ros.detect import Bend
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.errors import InputError, Notice
from dashcalib_ros.reconstruct.scene import Scene, TurnPicture
from dashcalib_ros.solve.solution import LeftOut, Solution
from dashcalib_ros.solve.spread import PictureSigma, sigma_over

# what OpenCV moves the pixels of
PIXEL_TYPES = ('uint8', 'uint16', 'int16', 'float32', 'float64')
# after the point, in one line of text
MOST_DIGITS = 9
Level = Literal['accepted', 'weak', 'refused']


@dataclass(frozen=True)
class Condition:
    """A condition of the verdict in words, what this drive has, what is needed, and whether met.

    value, limit: '' where two numbers do not say it. code: of the reason where it is not met.
    """

    code: str
    name: str
    value: str
    limit: str
    met: bool


@dataclass(frozen=True)
class Verdict:
    """accepted: use it. weak: look at the sigmas before using it. refused: there is no result.

    reasons: what is wrong, and what to do, the likeliest to help first. conditions: those that
    are not met, in the order of the reasons, then those that are met and that two numbers say.
    """

    level: Level
    reasons: tuple[Notice, ...] = ()
    conditions: tuple[Condition, ...] = ()

    @property
    def codes(self) -> tuple[str, ...]:
        """Return the codes of the reasons; a code stays when its text is reworded."""
        return tuple(reason.code for reason in self.reasons)

    @property
    def remedies(self) -> tuple[str, ...]:
        """Return what to do, the likeliest to help first."""
        return tuple(dict.fromkeys(each.remedy for each in self.reasons if each.remedy))

    @property
    def cures(self) -> tuple[str, ...]:
        """Return remedies, by their earlier name."""
        return self.remedies

    @property
    def accepted(self) -> bool:
        """Return whether the level is accepted."""
        return self.level == 'accepted'

    @property
    def main_reasons(self) -> tuple[Notice, ...]:
        """Return the reasons to show: of a refused result the first, as the others follow."""
        return self.reasons[:1] if self.level == 'refused' else self.reasons

    @property
    def main_text(self) -> str:
        """Return the main reasons in one line."""
        return '; '.join(map(str, self.main_reasons))


@dataclass(frozen=True)
class TurnSummary:
    """How one turn was used. center, first, last count the input's frames from 0.

    misfit: its cost with the shared camera, divided by that with its own: about 1, or less.
    unused_because: why it is not used, in words. right_deg: the heading at its end against that at
    its start, positive to the right.
    """

    center: int
    first: int
    last: int
    stamp_s: float
    prominence: float
    images: int
    registered: int
    used: bool
    yaw_deg: float | None = None
    reprojection_error_px: float | None = None
    misfit: float | None = None
    unused_because: str | None = None
    right_deg: float | None = None

    @property
    def id(self) -> TurnId:
        """Return the turn's identity."""
        return TurnId.at(self.center)


@dataclass(frozen=True)
class StoredTurnSummary:
    """How a turn of an earlier drive, or of a fleet's clip, was used. misfit: as for TurnSummary.

    clip: '' for an earlier drive.
    """

    id: TurnId
    stamp_s: float
    prominence: float
    yaw_deg: float
    images: int
    used: bool
    misfit: float | None = None
    unused_because: str | None = None
    reprojection_error_px: float | None = None
    clip: str = ''


@dataclass(frozen=True)
class Shutter:
    """A rolling shutter: ms from the first row to the last, and its standard deviation."""

    readout_ms: float
    sigma_ms: float


@dataclass(frozen=True)
class Stabiliser:
    """A stabilised video, its movement taken out. largest_px: how far its crop moved."""

    largest_px: float


@dataclass(frozen=True)
class Witness:
    """What a sensor knows: its clock, and the focal length, from the angles of the turns.

    time_offset_s: to subtract from the sensor's stamps; positive: its messages are late.
    drift_ppm: by how much it grows, us in a second. Each is None where it is not known; so is what
    follows, of a sensor that does not measure angles, or not well enough. scale: the sensor's
    angles over the camera's. fx_percent: by how much fx would have to change to agree with the
    sensor, of fx; fx_sigma_percent: with what the sensor's own scale may be off. agrees: no
    contradiction beyond 3 sigmas of both. camera_from_sensor: (3, 3) row by row, from the sensor's
    axes to the camera's; bias_rad_s: (3,) of the sensor's rates; both None where a sensor has
    none. scale_by_gps: a gyro's angles over those of GPS headings, and the sigma: taken out of
    scale; None where they say nothing.
    """

    time_offset_s: float | None
    time_sigma_s: float | None
    scale: float | None = None
    scale_sigma: float | None = None
    fx_percent: float | None = None
    fx_sigma_percent: float | None = None
    agrees: bool = True
    camera_from_sensor: tuple[tuple[float, ...], ...] | None = None
    alignment_sigma_deg: float | None = None
    bias_rad_s: tuple[float, ...] | None = None
    scale_by_gps: tuple[float, ...] | None = None
    drift_ppm: float | None = None
    drift_sigma_ppm: float | None = None

    @property
    def clock(self) -> dict[str, Any]:
        """Return what is known about the clock, by the names in result.json."""
        return {name: getattr(self, name) for name in (
            'time_offset_s', 'time_sigma_s', 'drift_ppm', 'drift_sigma_ppm')}

    def timed(self, other: Witness) -> Witness:
        """Return it with the clock of another."""
        return replace(self, **other.clock)

    def later(self, late_s: float) -> Witness:
        """Return it where that much was taken off the stamps before."""
        return self if self.time_offset_s is None else replace(
            self, time_offset_s=self.time_offset_s + late_s)


@dataclass(frozen=True)
class Witnesses:
    """The sensors that were compared; each None where it is not used. odometry: of speeds."""

    gyro: Witness | None = None
    gps: Witness | None = None
    odometry: Witness | None = None


@dataclass(frozen=True)
class LensField:
    """The smooth displacements over the picture that no lens model has, as of a windscreen.

    used: whether it is as large as its sigma; where not, it is in the sigmas only. sigma_px: how
    far rays with the camera and the field may be off over the picture, RMS.
    """

    field: Field
    used: bool
    rms_px: float
    worst_px: float
    sigma_px: float

    @property
    def text(self) -> str:
        """Return the clause that stands beside the camera's parameters, without a verb."""
        digits = 1 if self.rms_px >= 0.1 else 2
        return (f'a smooth field of {self.rms_px:.{digits}f} px, above its sigma of '
                f'{self.sigma_px:.{digits}f} px')


# of a mounting, and what its sigmas are named by
ANGLES = ('yaw_left_deg', 'pitch_up_deg', 'roll_right_deg')
# mountings that differ by less, in degrees or in sigmas, are the same
MOVED_DEG, MOVED_SIGMAS = 0.5, 3.0


@dataclass(frozen=True)
class Mount:
    """How the camera sits on the car, relative to the direction of travel and to the road.

    yaw_left_deg, pitch_up_deg: where the optical axis points, about 180 and upwards for a camera
    that looks back; roll_right_deg: by how much the camera is turned clockwise, as seen from
    behind it; None where it is not known. height_m: above the road; None where the speed is not
    known. sigma: by these four names. travel_px: the pixel (u, v) in which the car travels, or
    from which it comes where the camera looks back, with its sigma: less than that of the angles,
    which have the centre's, too. straight_m: of straight driving. moved_s: stamp after which the
    camera was moved, so that only what came later counts; None where it was not.
    """

    verdict: Literal['accepted', 'weak']
    reasons: tuple[Notice, ...]
    yaw_left_deg: float
    pitch_up_deg: float
    roll_right_deg: float | None
    height_m: float | None
    sigma: Mapping[str, float | None] = default(hash=False)
    travel_px: tuple[float, float]
    travel_sigma_px: float
    straight_m: float
    moved_s: float | None = None

    @property
    def rear(self) -> bool:
        """Return whether the camera looks back."""
        return abs(self.yaw_left_deg) > 90

    @property
    def rotation(self) -> Floats:
        """Return (3, 3): from the camera's optical frame to the car's (REP-103, REP-105).

        The car's x points ahead, y to the left, z upwards; the camera's z ahead, x to the right, y
        downwards. An unknown roll counts as 0.
        """
        roll, pitch, yaw = rotation_matrices(np.radians(np.diag([
            self.roll_right_deg or 0.0, -self.pitch_up_deg, self.yaw_left_deg])))
        return np.asarray(yaw @ pitch @ roll @ OPTICAL)

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """Return the same rotation as (x, y, z, w), as a transform base_link -> camera has it."""
        return quaternion(self.rotation)

    def apart(self, other: Mount) -> dict[str, tuple[float, float]]:
        """Return how far each angle that both know is from the other's, and the sigma, degrees."""
        found = {}
        for name in ANGLES:
            sigma, its_sigma = self.sigma[name], other.sigma[name]
            if sigma is not None and its_sigma is not None:
                degrees = math.remainder(getattr(self, name) - getattr(other, name), 360)
                found[name] = degrees, math.hypot(sigma, its_sigma)
        return found

    def moved_from(self, other: Mount) -> bool:
        """Return whether an angle is another one, by MOVED_SIGMAS and by MOVED_DEG."""
        return any(abs(degrees) > max(MOVED_DEG, MOVED_SIGMAS * sigma)
                   for degrees, sigma in self.apart(other).values())


@dataclass(frozen=True)
class Material:
    """What the report draws. px: of the input, in one pixel of the scenes.

    scenes: of all turns that were reconstructed, adjusted where the solution uses them. pictures:
    of turns of this drive.
    """

    px: float = 1.0
    solution: Solution | None = None
    scenes: Mapping[TurnId, Scene] = default(default_factory=dict)
    pictures: Mapping[TurnId, TurnPicture] = default(default_factory=dict)


def _places(given: npt.ArrayLike, columns: int, what: str) -> Floats:
    """Return places (..., columns) that a user gave. Raises InputError for another shape."""
    with suppress(TypeError, ValueError):
        found = np.asarray(given, np.float64)
        if found.shape[-1:] == (columns,):
            return found
    raise InputError('E-ARRAY-SHAPE', f'{what} must be numbers of the shape (..., {columns}), not '
                                      f'{given!r:.80}')


def _with_sigma(value: float, sigma: float) -> str:
    """Return a value and its sigma, both to the second digit of the sigma."""
    if not (math.isfinite(sigma) and sigma > 0):
        return f'{value:.6g}'
    digits = min(max(1 - math.floor(math.log10(sigma)), 0), MOST_DIGITS)
    return f'{value:.{digits}f} ± {sigma:.{digits}f}'


@dataclass(frozen=True)
class Drift:
    """A focal length that changes over the drive, as of a lens that warms up.

    fx_percent_per_hour, with its sigma; from_first_to_last_percent: over the turns.
    fx_percent_per_kelvin, with sigma_per_kelvin: where it follows the temperature, which is from_c
    to to_c degrees Celsius in these turns; None: it does not, or nobody measured it.
    """

    fx_percent_per_hour: float
    sigma: float
    from_first_to_last_percent: float
    fx_percent_per_kelvin: float | None = None
    sigma_per_kelvin: float | None = None
    from_c: float | None = None
    to_c: float | None = None

    def zoom(self, apart_k: float) -> float:
        """Return how many times as large fx is at so many kelvins above a calibration's."""
        return 1 + (self.fx_percent_per_kelvin or 0.0) / 100 * apart_k


@dataclass(frozen=True)
class CameraAt:
    """The camera at a time of the drive, where it changes. time_s: since the first image.

    sigma: by the names of intrinsics.
    """

    time_s: float
    intrinsics: Mapping[str, float] = default(hash=False)
    sigma: Mapping[str, float] = default(hash=False)


@dataclass(frozen=True)
class Part:
    """A part of a drive with a camera of its own, where that steps: see CalibrationData.

    from_s, to_s: since the first image, the turns that it is from.
    """

    from_s: float
    to_s: float
    verdict: Level
    reasons: tuple[str, ...]
    reason_codes: tuple[str, ...]
    camera_model: str | None
    intrinsics: Mapping[str, float] | None = default(hash=False)
    sigma: Mapping[str, float] | None = default(hash=False)
    sigma_px: PictureSigma | None = None


@dataclass(frozen=True)
class Known:
    """What somebody knew: fx in px, hfov in degrees, aspect, shutter in s, height in m.

    by_turns, by_turns_sigma: what the turns say without it. used: False where they contradict it.
    fx_sigma_without, fx_sigma: px, before and with it.
    """

    name: str
    value: float
    sigma: float
    by_turns: float
    by_turns_sigma: float
    used: bool
    fx_sigma_without: float
    fx_sigma: float


@dataclass(frozen=True, repr=False)
class CalibrationData:
    """The complete result. camera, sigma and covariance are None when the verdict is refused.

    camera: of the full-size images. sigma: by the parameters' names. covariance: (n, n) of the n
    parameters, in the order of camera.named; its diagonal is sigma squared; None where it is not
    known. picture_covariance: (w, w) of the parameters of the next larger lens model, what the
    model leaves out of the picture included.
    turns: of this drive; stored_turns: of earlier ones, see config turns.store.
    timing: seconds, keys detect, calibrate, total. versions: package name -> version.
    magnitudes: (n, 2) float64, columns stamp [s] and filtered turning magnitude [of the width].
    mask: (h, w) bool, True where the picture is valid (not ego vehicle); None if none was made.
    rolling_shutter: the one that was found, and whose effect was removed; None for a global one.
    stabiliser: the one that was found, and whose effect was removed; None for a fixed picture.
    mount: how the camera sits on the car; None where it is not known.
    field: what the camera's model leaves over; None: no evidence for one. camera is without it.
    sigma_px: how far the whole camera may be off over the picture. held_out: how each turn
    fits the calibration without it, full-size images' px; () for fewer than three turns.
    straight_lines: the distortion by upright lines of the world; None: too few of them.
    witnesses: the focal length by the car's own sensors. known: what somebody knew before.
    drift: of the focal length; camera is that of the middle of the drive then, or that of
    temperature_c where the focal length follows it. None: it is steady. temperature_c: mean of the
    turns, degrees Celsius; None: unknown.
    intrinsics_at: the camera over the time, where it drifts, zooms or steps. parts: before and
    after a step.
    part: (x, y, width, height) of the pictures, px, that camera and all else are of; None: all.
    start_s: stamp of the first image. material: what the report draws, None in a live drive.
    """

    verdict: Verdict
    image_size: tuple[int, int]
    camera: Camera | None
    sigma: Mapping[str, float] | None = default(hash=False)
    turns: tuple[TurnSummary, ...]
    frames: int
    reprojection_error_px: float | None
    timing: dict[str, float] = default(hash=False)
    versions: dict[str, str] = default(hash=False)
    config: Config
    input_name: str = ''
    part: tuple[int, int, int, int] | None = None
    warnings: tuple[Notice, ...] = ()
    magnitudes: Floats | None = default(default=None, compare=False)
    mask: Mask | None = default(default=None, compare=False)
    details: dict[str, Any] = default(default_factory=dict, hash=False)
    stored_turns: tuple[StoredTurnSummary, ...] = ()
    rolling_shutter: Shutter | None = None
    sigma_px: PictureSigma | None = None
    stabiliser: Stabiliser | None = None
    field: LensField | None = None
    mount: Mount | None = None
    held_out: tuple[LeftOut, ...] = ()
    straight_lines: Bend | None = None
    witnesses: Witnesses = default(default_factory=Witnesses)
    known: tuple[Known, ...] = ()
    drift: Drift | None = None
    temperature_c: float | None = None
    intrinsics_at: tuple[CameraAt, ...] = ()
    parts: tuple[Part, ...] = ()
    start_s: float = 0.0
    material: Material | None = default(default=None, compare=False)
    covariance: Floats | None = default(default=None, compare=False)
    picture_covariance: Floats | None = default(default=None, compare=False)

    def __repr__(self) -> str:
        """Return one line: the verdict, the parameters with their sigmas, or the first reason."""
        if self.camera is None:
            return f'Calibration({self.verdict.level}: {self.verdict.main_text})'
        sigma = self.sigma or {}
        found = [f'{name} {_with_sigma(value, sigma.get(name, math.nan))}'
                 for name, value in self.camera.named.items()]
        field = self._used_field and self.field
        text = (f'{self.verdict.level}, {self.camera.model}, {", ".join(found)}'
                + (f', and {field.text}' if field else ''))
        return f'Calibration({"; ".join(part for part in (text, self.caveat) if part)})'

    @property
    def caveat(self) -> str:
        """Return what must stand wherever the numbers stand; '' where nothing must."""
        lone = (self.camera is not None and self.turns_used == 1
                and not (self.verdict.level == 'accepted' and 'pictures_alone' in self.details))
        return 'from one turn alone, which nothing confirms' if lone else ''

    def at(self, time_s: float) -> tuple[Camera, Mapping[str, float] | None]:
        """Return the camera at a time, s since the first image, and its sigma.

        Between two times of intrinsics_at on a straight line, but not across a step; before the
        first and after the last one as there. Raises InputError where there is no camera.
        """
        camera, rows = self._camera, self.intrinsics_at
        if not rows:
            return camera, self.sigma
        if self.parts:
            middle_s = (self.parts[0].to_s + self.parts[1].from_s) / 2
            rows = tuple(row for row in rows
                         if (row.time_s > middle_s) == (time_s > middle_s)) or rows
        when = [row.time_s for row in rows]

        def values(name: str) -> dict[str, float]:
            return {key: float(np.interp(time_s, when, [
                getattr(row, name)[key] for row in rows])) for key in camera.named}

        return camera.with_params(list(values('intrinsics').values())), values('sigma')

    @property
    def K(self) -> Floats:  # noqa: N802, the field's name for it
        """Return the camera matrix (3, 3). Raises InputError where there is no camera."""
        return self._camera.matrix

    @property
    def D(self) -> Floats:  # noqa: N802
        """Return OpenCV's distortion coefficients, (5,), of a fisheye (4,). Raises InputError.

        Those of a fisheye are for cv2.fisheye.
        """
        return np.array(self._camera.ros_distortion())

    def sigma_at(self, pixels: npt.ArrayLike) -> Floats:
        """Return (n,) how far the camera may be off at pixels (n, 2), one sigma, px.

        The best common rotation is removed, as in sigma_px, which is the mean over the picture.
        NaN where the camera has no viewing ray. Raises InputError as samples() does.
        """
        camera, covariance = self._posterior
        at = _places(pixels, 2, 'pixels').reshape(-1, 2)
        found = np.full(len(at), np.nan)
        known = np.isfinite(camera.rays(at)[:, 0])
        found[known] = sigma_over(sensitivity(camera, at[known])[0], covariance)
        return found

    def samples(self, count: int, seed: int = 0) -> tuple[Camera, ...]:
        """Return cameras as likely as this one: draws from the normal distribution around it.

        They carry on through any pipeline what is not known about the lens. They are of the next
        larger lens model, for what this one leaves out counts, too. The same seed gives the same
        cameras. Raises InputError where there is no camera, or its covariance is not known.
        """
        camera, covariance = self._posterior
        drawn = np.random.default_rng(seed).multivariate_normal(
            camera.params, covariance, count, method='eigh')
        return tuple(type(camera).of(camera.image_size, params) for params in drawn)

    @property
    def _posterior(self) -> tuple[Camera, Floats]:
        """Return the camera in the wider model, and the covariance (n, n) of its parameters."""
        camera, covariance = self._camera.widened(), self.picture_covariance
        if covariance is None or covariance.shape != (len(camera.params),) * 2:
            raise InputError('E-UNKNOWN-COVARIANCE', 'this calibration does not contain the '
                             'correlations of its parameters: calibrate the drive again')
        return camera, covariance

    def rays(self, pixels: npt.ArrayLike) -> Floats:
        """Return the unit viewing rays (..., 3) of pixels (..., 2); x right, y down, z forward.

        With the field, where one is used. NaN where the lens has no ray. Raises InputError where
        there is no camera.
        """
        found = _places(pixels, 2, 'pixels')
        return self._camera.rays(found if self._used_field is None
                                 else self._used_field.ideal(found))

    def project(self, points: npt.ArrayLike) -> Floats:
        """Return the pixels (..., 2) of points (..., 3) in the camera's frame.

        With the field, where one is used. NaN where the lens does not see a point. Raises
        InputError where there is no camera.
        """
        found = self._camera.project(_places(points, 3, 'points'))
        return found if self._used_field is None else self._used_field.observed(found)

    @property
    def _used_field(self) -> Field | None:
        return self.field.field if self.field is not None and self.field.used else None

    def undistort(self, image: npt.ArrayLike) -> npt.NDArray[Any]:
        """Return an image without distortion, as a camera with the matrix K sees it.

        image: (height, width) or (height, width, channels), as cv2.imread() returns it. The field
        is taken out, too, where one is used. Raises InputError for what is not an image or one of
        another size, and where there is no camera.
        """
        camera, image = self._camera, np.asarray(image)
        if image.ndim not in (2, 3) or image.dtype not in PIXEL_TYPES:
            raise InputError('E-IMAGE-TYPE', f'undistort() takes an array (height, width) or '
                             f'(height, width, channels) of {", ".join(PIXEL_TYPES)}, not '
                             f'{image.shape} of {image.dtype}: read a file with cv2.imread(), '
                             f'which returns None where it cannot')
        if image.shape[1::-1] != camera.image_size:
            raise InputError('E-OTHER-IMAGE-SIZE',
                             f'the image has {image.shape[1]}x{image.shape[0]} pixels, and the '
                             f'calibration is for {camera.image_size[0]}x{camera.image_size[1]}: '
                             f'resize the image, or use `dashcalib export --size`')
        return rectify(image, camera, field=self._used_field)

    @property
    def _camera(self) -> Camera:
        if self.camera is None:
            raise InputError('E-CALIBRATION-REFUSED', 'the calibration was refused: '
                             f'{self.verdict.main_text}')
        return self.camera

    @property
    def field_of_view(self) -> tuple[float, float, float]:
        """Return degrees across, down and along the longer diagonal, of the picture's middle.

        Raises InputError where there is no camera.
        """
        return self._camera.field_of_view

    @property
    def intrinsics(self) -> dict[str, float] | None:
        """Return the camera's parameters by name."""
        return None if self.camera is None else self.camera.named

    @property
    def misfits(self) -> dict[TurnId, float]:
        """Return the misfits of all turns that were in the adjustment, by turn."""
        return {turn.id: turn.misfit for turn in self.all_turns if turn.misfit is not None}

    @property
    def used_turns(self) -> set[TurnId]:
        """Return the turns that the result is based on, including those of earlier drives."""
        return {turn.id for turn in self.all_turns if turn.used}

    @property
    def yaw_deg(self) -> float:
        """Return the yaw of the used turns together, degrees."""
        return sum(turn.yaw_deg or 0.0 for turn in self.all_turns if turn.used)

    @property
    def all_turns(self) -> tuple[TurnSummary | StoredTurnSummary, ...]:
        """Return the turns of this drive, then the stored ones."""
        return (*self.turns, *self.stored_turns)

    @property
    def turns_used(self) -> int:
        """Return how many turns the result is based on, including those of earlier drives."""
        return len(self.used_turns)
