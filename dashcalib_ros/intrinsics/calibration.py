"""What a calibration says: six parameters, a sigma for each, and a verdict with its reasons.

Pixel coordinates are ROS's and OpenCV's: the centre of the first pixel is (0, 0).
"""
from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from dashcalib_ros.config import Config

Level = Literal['accepted', 'weak', 'refused']


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole and two radial terms (paper, Eq. 1 and 2); also used for their six sigmas.

    fx, fy, cx, cy in pixels; k1, k2 without unit (plumb_bob's first two).
    """

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float


@dataclass(frozen=True)
class Verdict:
    """accepted: use it. weak: a look at the sigmas first. refused: there is no result."""

    level: Level
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True)
class TurnSummary:
    """What became of one turn. center, first, last count the input's frames from 0.

    misfit: cost with the common camera over cost with a camera of its own: about 1, or less.
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


@dataclass(frozen=True)
class StoredTurnSummary:
    """What became of a turn of an earlier drive. key: its negative number in this run.

    misfit: as for TurnSummary.
    """

    key: int
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
class Calibration:
    """The whole result. intrinsics and sigma are None when the verdict is refused.

    turns: of this drive; stored_turns: of earlier ones, see config turns.store.
    timing: seconds, keys detect, calibrate, total. versions: package name -> version.
    magnitudes: (n, 2) float64, columns stamp [s] and filtered turning magnitude [of the width].
    mask: (h, w) bool, True where the picture is valid (not ego vehicle); None if none was made.
    rolling_shutter: what was found and undone; None for a global one.
    """

    verdict: Verdict
    image_size: tuple[int, int]
    intrinsics: Intrinsics | None
    sigma: Intrinsics | None
    turns: tuple[TurnSummary, ...]
    frames: int
    reprojection_error_px: float | None
    timing: dict[str, float]
    versions: dict[str, str]
    config: Config
    input_name: str = ''
    warnings: tuple[str, ...] = ()
    magnitudes: npt.NDArray[np.float64] | None = None
    mask: npt.NDArray[np.bool_] | None = None
    details: dict[str, Any] = field(default_factory=dict)
    stored_turns: tuple[StoredTurnSummary, ...] = ()
    rolling_shutter: Shutter | None = None

    @property
    def misfits(self) -> dict[int, float]:
        """Return the misfits of all turns that were tried, by centre or a stored one's key."""
        found = {turn.center: turn.misfit for turn in self.turns}
        found |= {turn.key: turn.misfit for turn in self.stored_turns}
        return {key: misfit for key, misfit in found.items() if misfit is not None}

    @property
    def turns_used(self) -> int:
        """Return how many turns the result is made of, those of earlier drives included."""
        return sum(turn.used for turn in self.turns) + sum(
            turn.used for turn in self.stored_turns)
