"""Feeding a drive to the calibrator, and closing everything whatever happens."""
from __future__ import annotations

import dataclasses
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from dashcalib_ros.calibrator import Calibrator
from dashcalib_ros.cli.terminal import Stages
from dashcalib_ros.config import Config
from dashcalib_ros.frames import FrameSource
from dashcalib_ros.frames.mask_file import check_mask
from dashcalib_ros.intrinsics import Calibration

if TYPE_CHECKING:
    Mask = npt.NDArray[np.bool_]


@contextmanager
def open_calibrator(config: Config, mask: Mask | None, verbose: bool) -> Iterator[Calibrator]:
    """Make a calibrator that is closed at the end, even if Ctrl-C is pressed again meanwhile."""
    calibrator = Calibrator(config, mask, verbose)
    try:
        yield calibrator
    finally:
        with _undisturbed():
            calibrator.close()


def feed(calibrator: Calibrator, source: FrameSource, mask: Mask | None, stages: Stages) -> int:
    """Push every frame of the drive; return how many there were."""
    frames = 0
    stages.show('reading', None)
    for frame in source:
        if not frames:
            check_mask(mask, frame.size)
        status = calibrator.push(frame)
        frames += 1
        turns = '1 turn' if status.turns == 1 else f'{status.turns} turns'
        stages.show('reading', frames / source.count if source.count else None,
                    f'frame {frames}, {turns}')
    return frames


def calibrate(source: FrameSource, config: Config, mask: Mask | None, verbose: bool,
              stages: Stages) -> Calibration:
    """Calibrate a whole drive; the input's name and warnings are in the result."""
    with open_calibrator(config, mask, verbose) as calibrator:
        feed(calibrator, source, mask, stages)
        calibration: Calibration = calibrator.calibrate(stages.show)
    new = tuple(line for line in source.warnings if line not in calibration.warnings)
    return dataclasses.replace(calibration, input_name=calibration.input_name or source.name,
                               warnings=(*new, *calibration.warnings))


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Hold Ctrl-C and SIGTERM off while a child process is being ended."""
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
