"""Recorded drives in one call: files in, a Calibration or an answer out."""
from __future__ import annotations

import os
import time
from collections.abc import Generator, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from dashcalib_ros.arrays import Mask
from dashcalib_ros.camera import Camera
from dashcalib_ros.config import Config
from dashcalib_ros.detect.detection import Detection
from dashcalib_ros.errors import InputError
from dashcalib_ros.input import Frame, FrameSource
from dashcalib_ros.input.decode import check_mask, read_mask
from dashcalib_ros.input.inputs import Paths, fits_bag, open_frames
from dashcalib_ros.input.motion import SensorStream
from dashcalib_ros.input.motion_files import bag_motion, read_motion
from dashcalib_ros.input.source import by
from dashcalib_ros.judge import Check
from dashcalib_ros.pipeline import Calibrator
from dashcalib_ros.questions import Questions
from dashcalib_ros.report import Calibration
from dashcalib_ros.workers.worker import Progress

MaskOrPath = str | os.PathLike[str] | npt.NDArray[Any] | None
# what frames are pushed into
Taker = Calibrator | Detection
# s between two looks whether an image has been read
READING_S = 0.01


def calibrate(path: Paths, fps: float | None = None,
              config: Config | None = None, topic: str | None = None, start_s: float = 0.0,
              duration_s: float | None = None, mask: MaskOrPath = None,
              progress: Progress | None = None,
              motion: str | os.PathLike[str] | SensorStream | None = None) -> Calibration:
    """Calibrate a recorded drive.

    path: a ROS 2 bag (folder, .mcap, .db3), a ROS 1 .bag, a video, a folder of images, or several
    of these of one camera (a sequence, a folder of videos, or a pattern such as 'clips/*.mp4').
    fps: images per second of a folder (default 10), or instead of what a video says.
    config: the settings; None: Config().
    topic: the image topic of a bag; needed only when it has several.
    start_s, duration_s: the part of the drive to use, in seconds; None: to its end.
    mask: what is not to be used (bonnet, burnt-in text): a picture's path, black there, or an
    array (height, width), 0 or False there; in addition to what is found by itself.
    progress: called with the stage's name and the share done, 0 to 1.
    motion: the car's own sensors: a CSV, a GPX or a KITTI oxts folder, or a stream. None: of a
    bag, its own topics.

    Returns a Calibration: its verdict.level is 'accepted', 'weak' or 'refused', and where it is
    refused its camera is None. Raises InputError for what cannot be read, ConfigError for a bad
    setting, WorkerError where a child process cannot run.
    """
    source, tell = open_frames(path, topic, fps, start_s, duration_s), progress or _silent
    sensors = motion if isinstance(motion, SensorStream) else drive_motion(
        path, motion, start_s=start_s, topic=topic)
    with _fed(source, config, mask, tell) as calibrator:
        if sensors is not None:
            calibrator.sense(sensors)
        return with_source(calibrator.calibrate(tell), source)


def check(given: Camera, path: Paths, fps: float | None = None,
          config: Config | None = None, topic: str | None = None, start_s: float = 0.0,
          duration_s: float | None = None, mask: MaskOrPath = None,
          progress: Progress | None = None) -> Check:
    """Say whether a camera explains a recorded drive.

    given: a Radial, Brown, Rational or Fisheye of the drive's pictures, such as
    load_camera('camera.yaml').camera.
    path: a ROS 2 bag (folder, .mcap, .db3), a ROS 1 .bag, a video, a folder of images, or several
    of these of one camera (a sequence, a folder of videos, or a pattern such as 'clips/*.mp4').
    fps: images per second of a folder (default 10), or instead of what a video says.
    config: the settings; None: Config().
    topic: the image topic of a bag; needed only when it has several.
    start_s, duration_s: the part of the drive to use, in seconds; None: to its end.
    mask: what is not to be used: a picture's path, black there, or an array (height, width), 0 or
    False there.
    progress: called with the stage's name and the share done, 0 to 1.

    Returns a Check: its answer is 'right', 'wrong' or 'cannot tell', with reasons. Raises
    InputError for what cannot be read, ConfigError for a bad setting, WorkerError where a child
    process cannot run.
    """
    source, tell = open_frames(path, topic, fps, start_s, duration_s), progress or _silent
    with _fed(source, config, mask, tell) as calibrator:
        return Questions(calibrator).check(source.shown(given), calibrator.calibrate(tell), tell)


def drive_motion(path: Paths, motion: str | os.PathLike[str] | None = None,
                 chosen: Mapping[str, str | None] = MappingProxyType({}),
                 start_s: float = 0.0, topic: str | None = None) -> SensorStream | None:
    """Return what the file motion has, else what the bags of a drive have; None where none is.

    start_s: of the part of the drive that is used: a CSV counts from the drive's first image.
    chosen: the bag's topic by imu, gps and odom; topic: its images'. Raises InputError for a file
    of another kind, and for a topic that there is not.
    """
    wanted = {name: topic for name, topic in chosen.items() if topic is not None}
    if motion is not None:
        if wanted:
            raise InputError('--imu, --gps and --odom choose topics of a bag: leave them or '
                             '--motion away')
        found = read_motion(Path(motion))
        return found if found.absolute else found.shifted(-start_s)
    given = [path] if isinstance(path, (str, os.PathLike)) else list(path)
    try:
        bags = [each for each in map(Path, given) if each.exists() and fits_bag(each)]
        return bag_motion(bags, wanted, topic) if bags else None
    except (InputError, OSError, ValueError):
        if wanted:
            raise
        return None  # what is wrong with the bag, its pictures will tell


@contextmanager
def _fed(source: FrameSource, config: Config | None, mask: MaskOrPath, tell: Progress
         ) -> Iterator[Calibrator]:
    """Give a calibrator that has taken every frame of the drive."""
    valid = _valid(mask)
    with Calibrator(config, valid) as calibrator:
        for frames in pushed(calibrator, source, valid):
            tell('reading', min(frames / source.count, 1.0) if source.count else 0.0)
        yield calibrator


def pushed(taker: Taker, source: FrameSource, mask: Mask | None) -> Iterator[int]:
    """Push every frame of the drive; yield after each how many there were.

    Raises InputError for a mask of another size.
    """
    for number, frame in enumerate(_read_ahead(source), 1):
        if number == 1:
            check_mask(mask, frame.size)
        taker.push(frame)
        yield number


def _read_ahead(source: FrameSource) -> Iterator[Frame]:
    """Yield every frame of the drive, while a thread decodes the next one."""
    frames, reader = iter(source), ThreadPoolExecutor(1)
    try:
        coming = reader.submit(next, frames, None)
        while (frame := coming.result()) is not None:
            coming = reader.submit(next, frames, None)
            yield frame
    finally:
        # Ctrl-C in the middle of a lock's own code leaves it locked: the thread is not waited for
        reader.shutdown(wait=False)
        _close(frames)


def _close(frames: Generator[Frame, None, None]) -> None:
    """End the reading of a drive, which removes temporary files, after the read under way."""
    while True:
        try:
            frames.close()
        except ValueError:  # it is running
            time.sleep(READING_S)
        else:
            return


def _valid(mask: MaskOrPath) -> Mask | None:
    if mask is None or isinstance(mask, (str, os.PathLike)):
        return None if mask is None else read_mask(Path(mask))
    if mask.ndim != 2:
        raise InputError(f'the mask has the shape {mask.shape}: give (height, width)')
    return np.asarray(mask) > 0


def _silent(stage: str, done: float) -> None:
    """Tell nobody."""


def with_source(calibration: Calibration, source: FrameSource) -> Calibration:
    """Return the calibration with its input's name and warnings, its pictures in colour.

    What the input contradicts is the first reason of one that is not accepted: it may be why.
    """
    verdict, material = calibration.verdict, calibration.material
    doubts = source.contradictions if verdict.level != 'accepted' else ()
    new = tuple(line for line in source.warnings
                if line not in (*doubts, *calibration.warnings))
    if doubts:
        cures = (line.rpartition(': ')[2] for line in doubts)
        verdict = replace(verdict, reasons=(*doubts, *verdict.reasons),
                          cures=(*cures, *verdict.cures))
    if material is not None:
        shown = material.pictures
        images = source.in_colour({each.frame: each.stamp_ns for each in shown.values()})
        material = replace(material, pictures={
            turn: each.coloured(images[each.frame]) if each.frame in images else each
            for turn, each in shown.items()})
    stored = calibration.camera and source.stored(calibration.camera)
    if stored:
        values = ', '.join(f'{name} {value:.2f}' for name, value in zip(
            ('fx', 'fy', 'cx', 'cy'), stored.params, strict=False))
        new += (f'for the pictures as they are stored ({by(stored.image_size)}): {values}, and '
                f'the same distortion',)
    return replace(calibration, verdict=verdict, material=material,
                   input_name=calibration.input_name or source.name,
                   warnings=(*new, *calibration.warnings))
