"""The core's stages one by one: detection first, then reconstruction of turns that are given.

`dashcalib run` overlaps them; rivals and curves need them apart. This is the only file here that
reaches into the Calibrator.
"""
from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from dashcalib_ros import Calibrator, Config
from dashcalib_ros.frames import Frame
from dashcalib_ros.frames.shrink import shrink, shrink_factor
from dashcalib_ros.intrinsics import Calibration
from dashcalib_ros.motion import MotionEstimator
from dashcalib_ros.turns import Turn, TurnDetector


@dataclass(frozen=True)
class Detected:
    """What detection made of a drive.

    turns: the best first, with their frames. frames: all that were not thinned away, at the size
    that is reconstructed. size: (width, height) of the input. count: its frames.
    """

    turns: tuple[Turn, ...]
    frames: tuple[Frame, ...]
    size: tuple[int, int]
    count: int
    motion: MotionEstimator
    seconds: float


class GivenTurns(TurnDetector):
    """A TurnDetector of a drive that is over; all else it does to its empty bank."""

    def __init__(self, config: Config, turns: Sequence[Turn]) -> None:
        super().__init__(config.turns)
        self._turns = list(turns)

    def turns(self) -> tuple[Turn, ...]:
        """Return the turns, best first."""
        return tuple(self._turns)

    def release(self, center: int) -> None:
        """Drop a turn's frames."""
        self._turns = [replace(turn, frames=(), released_images=turn.images)
                       if turn.center == center else turn for turn in self._turns]

    def finish(self) -> list[Turn]:
        """Do nothing: it was over before."""
        return []

    def magnitudes(self) -> npt.NDArray[np.float64]:
        """Return no signal."""
        return np.zeros((0, 2))


def detect(frames: Iterable[Frame], config: Config) -> Detected:
    """Find the turns; their frames, and all others, stay in memory."""
    motion = MotionEstimator(config.motion, config.mask)
    detector = TurnDetector(replace(
        config.turns, capacity=max(config.turns.capacity, config.turns.wanted)))
    kept, count, seconds, size = [], 0, 0.0, (1, 1)
    for frame in frames:
        started = time.monotonic()
        count, size = count + 1, frame.size
        small = shrink(frame, shrink_factor(size, config.max_width))
        found = motion.push(small)
        if found is not None:
            detector.push(small, found)
            kept.append(small)
        seconds += time.monotonic() - started
    detector.finish()
    return Detected(detector.turns(), tuple(kept), size, count, motion, seconds)


@contextmanager
def given(detected: Detected, turns: Sequence[Turn], config: Config) -> Iterator[Calibrator]:
    """Give a Calibrator that has found these turns, and reconstructed none of them yet."""
    with Calibrator(config) as calibrator:
        found = GivenTurns(config, turns)
        calibrator._motion, calibrator._detector = detected.motion, found
        calibrator._scenes.valid, calibrator._scenes.detector = detected.motion.valid, found
        calibrator._size = detected.size
        calibrator._frames = detected.count
        yield calibrator


def from_turns(detected: Detected, turns: Sequence[Turn], config: Config
               ) -> tuple[Calibration, float]:
    """Return the calibration, and the seconds from these turns to it: processes start cold."""
    with given(detected, turns, config) as calibrator:
        started = time.monotonic()
        return calibrator.calibrate(), time.monotonic() - started


def with_so_many(calibrator: Calibrator, count: int) -> Calibration:
    """Return the calibration with the best so many turns; their scenes are built only once."""
    # a scene that did not fit two others may well fit nine
    calibrator._scenes.reject = lambda keys: None  # type: ignore[method-assign]
    calibrator._scenes.places = count
    return calibrator.calibrate(final=False)


def random_windows(detected: Detected, lengths: Sequence[int], seed: int) -> list[Turn]:
    """Return windows of so many frames each, anywhere in the drive, none over another.

    Raises ValueError when the drive has no room for them.
    """
    rng = np.random.default_rng([seed, 8])
    frames = detected.frames
    if sum(lengths) > len(frames):
        raise ValueError('the drive is too short for so many windows')
    # the gaps share what the windows leave, each division as likely as the next
    free = len(frames) - sum(lengths)
    starts = np.sort(rng.integers(0, free + 1, len(lengths)))
    starts += np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(int)
    windows = []
    for start, length in zip(starts, lengths, strict=True):
        part = frames[start:start + length]
        middle = part[length // 2]
        windows.append(Turn(middle.index, part[0].index, part[-1].index, middle.stamp_ns / 1e9,
                            0.0, part))
    return windows
