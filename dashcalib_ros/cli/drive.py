"""Feeding a drive to the calibrator, which is closed in any case."""
from __future__ import annotations

import argparse
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol

from dashcalib_ros.arrays import Mask
from dashcalib_ros.calibrator import Calibrator
from dashcalib_ros.cli.terminal import Stages
from dashcalib_ros.config import Config
from dashcalib_ros.detect import Turn
from dashcalib_ros.errors import counted
from dashcalib_ros.input import Frame, FrameSource
from dashcalib_ros.input.decode import check_mask
from dashcalib_ros.input.inputs import open_frames
from dashcalib_ros.judge import Calibration
from dashcalib_ros.recorded import with_source


def open_drive(args: argparse.Namespace) -> FrameSource:
    """Open what the arguments name. Raises InputError."""
    return open_frames(args.input, args.topic, args.fps, args.start, args.duration)


@contextmanager
def open_calibrator(config: Config, mask: Mask | None, verbose: bool) -> Iterator[Calibrator]:
    """Make a calibrator that is closed at the end, even if Ctrl-C is pressed again meanwhile."""
    calibrator = Calibrator(config, mask, verbose)
    try:
        yield calibrator
    finally:
        with _undisturbed():
            calibrator.close()


class Taker(Protocol):
    """What frames are pushed into: a Calibrator or a Detection."""

    def push(self, frame: Frame) -> object:
        """Take the next frame."""

    def turns(self) -> tuple[Turn, ...]:
        """Return the turns found so far."""


def feed(taker: Taker, source: FrameSource, mask: Mask | None, stages: Stages) -> int:
    """Push every frame of the drive; return how many there were."""
    frames = 0
    stages.show('reading', None)
    for frame in source:
        if not frames:
            check_mask(mask, frame.size)
        taker.push(frame)
        frames += 1
        count = len(taker.turns())
        stages.show('reading', frames / source.count if source.count else None,
                    f'frame {frames}, {counted(count, "turn")}')
    return frames


def calibrate(source: FrameSource, config: Config, mask: Mask | None, verbose: bool,
              stages: Stages) -> Calibration:
    """Calibrate a whole drive; the input's name and warnings are in the result."""
    with open_calibrator(config, mask, verbose) as calibrator:
        feed(calibrator, source, mask, stages)
        calibration: Calibration = calibrator.calibrate(stages.show)
    return with_source(calibration, source)


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Ignore Ctrl-C and SIGTERM while child processes are being ended."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before: dict[signal.Signals, Any] = {
        name: signal.signal(name, signal.SIG_IGN) for name in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for name, handler in before.items():
            signal.signal(name, handler)
