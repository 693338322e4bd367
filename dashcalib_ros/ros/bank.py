"""A bank of turns that belong together, and the images that wait to be searched for them."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from dashcalib_ros.calibrator import Calibrator
from dashcalib_ros.detect import TurnId
from dashcalib_ros.input.decode import BitDepth


class Bank:
    """A Calibrator and what belongs to its images only.

    depth: used by the detecting thread only. tried: the turns of the last calibration. told: the
    turns that the node knows of. more: turns of this drive that are used beyond those
    wanted. The learner's lock guards these.
    """

    def __init__(self, number: int, calibrator: Calibrator) -> None:
        self.number = number
        self.calibrator = calibrator
        self.depth = BitDepth()
        self.tried: frozenset[TurnId] = frozenset()
        self.told: frozenset[TurnId] = frozenset()
        self.more = 0


@dataclass(frozen=True)
class Job:
    """An image that waits for detection, and the bank that it is for."""

    bank: Bank
    index: int
    stamp_ns: int
    message: Any
    size: tuple[int, int]
    frame_id: str
