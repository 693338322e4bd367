"""The result of a calibration: a camera, a sigma for each parameter, a verdict with reasons."""
from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from dashcalib_ros.arrays import Floats, Mask
from dashcalib_ros.camera import Camera
from dashcalib_ros.config import Config
from dashcalib_ros.errors import InputError
from dashcalib_ros.solve.picture import PictureSigma
from dashcalib_ros.turns.turn import TurnId

Level = Literal['accepted', 'weak', 'refused']


@dataclass(frozen=True)
class Verdict:
    """accepted: use it. weak: look at the sigmas before using it. refused: there is no result."""

    level: Level
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True)
class TurnSummary:
    """How one turn was used. center, first, last count the input's frames from 0.

    misfit: its cost with the shared camera, divided by that with its own: about 1, or less.
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

    @property
    def id(self) -> TurnId:
        """Return the turn's identity."""
        return TurnId.at(self.center)


@dataclass(frozen=True)
class StoredTurnSummary:
    """How a turn of an earlier drive was used. misfit: as for TurnSummary."""

    id: TurnId
    stamp_s: float
    prominence: float
    yaw_deg: float
    images: int
    used: bool
    misfit: float | None = None


@dataclass(frozen=True)
class Shutter:
    """A rolling shutter: ms from the first row to the last, and its standard deviation."""

    readout_ms: float
    sigma_ms: float


@dataclass(frozen=True)
class Stabiliser:
    """A stabilised video, its movement taken out. largest_px: how far its crop moved."""

    largest_px: float


@dataclass(frozen=True, repr=False)
class Calibration:
    """The complete result. camera and sigma are None when the verdict is refused.

    camera: of the full-size images. sigma: by the parameters' names.
    turns: of this drive; stored_turns: of earlier ones, see config turns.store.
    timing: seconds, keys detect, calibrate, total. versions: package name -> version.
    magnitudes: (n, 2) float64, columns stamp [s] and filtered turning magnitude [of the width].
    mask: (h, w) bool, True where the picture is valid (not ego vehicle); None if none was made.
    rolling_shutter: the one that was found, and whose effect was removed; None for a global one.
    stabiliser: the one that was found, and whose effect was removed; None for a fixed picture.
    sigma_px: how far the whole camera may be off over the picture.
    """

    verdict: Verdict
    image_size: tuple[int, int]
    camera: Camera | None
    sigma: Mapping[str, float] | None
    turns: tuple[TurnSummary, ...]
    frames: int
    reprojection_error_px: float | None
    timing: dict[str, float]
    versions: dict[str, str]
    config: Config
    input_name: str = ''
    warnings: tuple[str, ...] = ()
    magnitudes: Floats | None = None
    mask: Mask | None = None
    details: dict[str, Any] = field(default_factory=dict)
    stored_turns: tuple[StoredTurnSummary, ...] = ()
    rolling_shutter: Shutter | None = None
    sigma_px: PictureSigma | None = None
    stabiliser: Stabiliser | None = None

    def __repr__(self) -> str:
        """Return one line: the verdict, the parameters with their sigmas, or the first reason."""
        if self.camera is None:
            return f'Calibration({self.verdict.level}: {"; ".join(self.verdict.reasons[:1])})'
        sigma = self.sigma or {}
        found = [f'{name} {value:.6g} ± {sigma.get(name, math.nan):.1g}'
                 for name, value in self.camera.named.items()]
        return f'Calibration({self.verdict.level}, {self.camera.model}, {", ".join(found)})'

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

    def undistort(self, image: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return an image without distortion, as a camera with the matrix K sees it.

        Raises InputError for an image of another size, and where there is no camera.
        """
        import cv2
        camera = self._camera
        if image.shape[1::-1] != camera.image_size:
            raise InputError(f'the image has {image.shape[1]}x{image.shape[0]} pixels, and the '
                             f'calibration is for {camera.image_size[0]}x{camera.image_size[1]}')
        if camera.sees_behind:
            return np.asarray(cv2.fisheye.undistortImage(image, self.K, self.D, Knew=self.K))
        return np.asarray(cv2.undistort(image, self.K, self.D))

    @property
    def _camera(self) -> Camera:
        if self.camera is None:
            raise InputError(f'the calibration was refused: {"; ".join(self.verdict.reasons)}')
        return self.camera

    @property
    def intrinsics(self) -> dict[str, float] | None:
        """Return the camera's parameters by name."""
        return None if self.camera is None else self.camera.named

    @property
    def misfits(self) -> dict[TurnId, float]:
        """Return the misfits of all turns that were in the adjustment, by turn."""
        return {turn.id: turn.misfit for turn in self._all_turns if turn.misfit is not None}

    @property
    def used_turns(self) -> set[TurnId]:
        """Return the turns that the result is based on, including those of earlier drives."""
        return {turn.id for turn in self._all_turns if turn.used}

    @property
    def _all_turns(self) -> tuple[TurnSummary | StoredTurnSummary, ...]:
        return (*self.turns, *self.stored_turns)

    @property
    def turns_used(self) -> int:
        """Return how many turns the result is based on, including those of earlier drives."""
        return len(self.used_turns)
