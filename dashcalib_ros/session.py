# SPDX-License-Identifier: Apache-2.0
"""A recorded drive in, a result out: the one wiring of the command, Python and the fleet."""
from __future__ import annotations

import os
import time
from collections.abc import Generator, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy.typing as npt

from dashcalib_ros import judge
from dashcalib_ros.arrays import Mask
from dashcalib_ros.camera import searched
from dashcalib_ros.config import Config
from dashcalib_ros.errors import InputError, Notice, counted, spared
from dashcalib_ros.formats import Given, given_camera, load_camera
from dashcalib_ros.input import Frame, FrameSource
from dashcalib_ros.input.decode import check_mask, mask_of
from dashcalib_ros.input.inputs import Paths, as_list, fits_bag, open_frames
from dashcalib_ros.input.motion import SensorStream
from dashcalib_ros.input.motion_files import bag_motion, read_motion, read_temperature
from dashcalib_ros.input.poses import Poses, track_poses
from dashcalib_ros.input.source import size_text
from dashcalib_ros.judge import Check, Odometry
from dashcalib_ros.judge.calibration import Material
from dashcalib_ros.judge.conclude import Outlook, outlook
from dashcalib_ros.judge.witnesses import SensorComparison
from dashcalib_ros.limits import path_of
from dashcalib_ros.pipeline import Calibrator
from dashcalib_ros.report import Calibration, NamedCamera
from dashcalib_ros.workers.worker import Progress

MaskOrPath = str | os.PathLike[str] | npt.NDArray[Any] | None
MotionOrPath = str | os.PathLike[str] | SensorStream | None
Part = tuple[int, int, int, int]
Settings = Config | Mapping[str, Any] | None
# s between two looks whether an image has been read
READING_S = 0.01


class Observer:
    """Sees the progress of a drive; this one does nothing with it."""

    def show(self, stage: str, share: float | None = None, note: str = '') -> None:
        """Take the stage's name, the share done, 0 to 1 (None: unknown), and a note."""

    def closing(self) -> AbstractContextManager[None]:
        """Return what surrounds the end of the child processes."""
        return nullcontext()


@dataclass(frozen=True)
class Recording:
    """A recorded drive: its frames, where they are not to be used, and the car's sensors.

    warmth: with the temperature, where a file of its own has it.
    """

    source: FrameSource
    mask: Mask | None = None
    motion: SensorStream | None = None
    warmth: SensorStream | None = None


@dataclass(frozen=True)
class Checked:
    """What a drive says about a given camera.

    changes: of the camera during the drive, in words. odometry: the motion in the turns beside
    true poses; None without poses.
    """

    check: Check
    calibration: Calibration
    changes: tuple[str, ...] = ()
    odometry: Odometry | None = None


def open_drive(path: Paths, topic: str | None = None, fps: float | None = None,
               start_s: float = 0.0, duration_s: float | None = None, mask: MaskOrPath = None,
               motion: MotionOrPath = None,
               sensor_topics: Mapping[str, str | None] = MappingProxyType({}),
               crop: Part | None = None, stamps: str | os.PathLike[str] | None = None,
               columns: Mapping[str, str] | None = None, sensor_offset_s: float = 0.0,
               temperature: str | None = None) -> Recording:
    """Open a recorded drive; the parameters are those of calibrate().

    sensor_topics: of a bag, by imu, gps and odom. stamps: a list of the times of a folder's
    images. columns: of a CSV, as read_motion()'s. sensor_offset_s: to add to the stamps of the
    sensors. temperature: of the camera, a CSV or a topic of a bag. Raises InputError.
    """
    valid, paths = mask_of(mask), as_list(path)
    source = open_frames(paths, topic=topic, fps=fps, start_s=start_s, duration_s=duration_s,
                         stamps=stamps)
    source = source if crop is None else source.cropped(*crop)
    if isinstance(motion, SensorStream):
        return Recording(source, valid, _on_clock_of(source, motion))
    warmth = None
    if temperature is not None and Path(temperature).exists():
        warmth = read_temperature(path_of(temperature))
    elif temperature is not None:
        sensor_topics = {**sensor_topics, 'temperature': temperature}

    def placed(sensors: SensorStream | None) -> SensorStream | None:
        if sensors is None:
            return None
        sensors = _on_clock_of(source, sensors.shifted(sensor_offset_s))
        # it counts from the drive's first image, not from the first one that is used
        return sensors if sensors.absolute else sensors.shifted(-start_s)

    sensors = drive_motion(paths, motion, sensor_topics, topic, columns)
    return Recording(source, valid, placed(sensors), placed(warmth))


def _on_clock_of(source: FrameSource, sensors: SensorStream) -> SensorStream:
    return sensors.on_clock_of(source.begin_ns, source.recorded, source.length_ns)


def calibrate_drive(drive: Recording, config: Config | None = None,
                    observer: Observer | None = None, verbose: bool = False) -> Calibration:
    """Calibrate a recorded drive; the input's name and warnings are in the result."""
    observer = observer or Observer()
    with learned_drive(drive, config, observer, verbose) as calibrator:
        return with_source(calibrator.calibrate(observer.show), drive.source)


def outlook_of(drive: Recording, config: Config | None = None,
               observer: Observer | None = None) -> Outlook:
    """Find the turns of a recorded drive, and say whether they are enough for a calibration."""
    observer = observer or Observer()
    with learned_drive(drive, config, observer, False) as calibrator:
        calibrator.detection.finish()
        scenes = calibrator.reconstruct(observer.show, final=True)
        evidence = calibrator.evidence(time.monotonic(), SensorComparison())
        return outlook(scenes, evidence, calibrator.scenes.config.verdict)


def check_drive(drive: Recording, named: NamedCamera, config: Config | None = None,
                observer: Observer | None = None, poses: Poses | None = None,
                track: SensorStream | None = None, verbose: bool = False) -> Checked:
    """Calibrate a recorded drive, and compare a given camera with what its turns show.

    named: the given camera, of the pictures as they are stored. poses: true ones of the drive;
    track: GPS positions, from which poses are made. Raises InputError where no turn
    has poses.
    """
    observer = observer or Observer()
    given = drive.source.shown(named.camera)
    with learned_drive(drive, config, observer, verbose) as calibrator:
        calibration = calibrator.calibrate(observer.show)
        observer.show('the turns with the given camera', 0.0)
        solution, run, settings = (calibrator.solution, calibrator.workers.run,
                                   calibration.config)
        check: Check = run(judge.check, given, calibration.image_size, solution,
                           calibration.verdict, settings, calibrator.detection.lines(), named.name)
        if given.image_size != calibration.image_size:
            return Checked(check, calibration)  # it explains no motion either
        lens = calibrator.detection.resized(given)
        readings = run(judge.readings_of, calibrator.scenes.reconstructed(), lens, settings)
        monitor = judge.watch(readings, lens, None, settings.monitor)
        if track is not None:
            track = _on_clock_of(drive.source, track).since(calibration.start_s)
            assert track.position is not None
            poses = track_poses(track.position, calibration.start_s)
        odometry: Odometry | None = None
        if poses is not None and solution is not None:
            observer.show('the turns beside the poses', 0.0)
            odometry = run(judge.beside_poses, solution, lens, poses, settings)
    return Checked(check, calibration, tuple(map(str, monitor.changes)), odometry)


@contextmanager
def in_order(given: Given, path: Paths) -> Iterator[None]:
    """Let an InputError of opening both say, where it is so, that they are exchanged."""
    try:
        yield
    except InputError as error:
        paths = as_list(path)
        if len(paths) == 1 and _is_calibration(paths[0]) and not _is_calibration(given):
            raise InputError('E-ARGUMENTS-EXCHANGED',
                             f'{paths[0]} is a calibration, and {given} is none: exchange them, '
                             f'the calibration comes first') from error
        raise


def _is_calibration(given: Given) -> bool:
    """Return whether this is a calibration, and no drive: a bag may be both."""
    if not isinstance(given, (str, os.PathLike)):
        return True
    try:
        return not fits_bag(Path(given)) and bool(load_camera(given))
    except (InputError, OSError):
        return False


@contextmanager
def learned_drive(drive: Recording, config: Config | None, observer: Observer, verbose: bool
             ) -> Iterator[Calibrator]:
    """Give a calibrator that has taken every frame and what the sensors say."""
    calibrator = Calibrator(config, drive.mask, verbose)
    try:
        calibrator.sense(drive.motion, drive.warmth)
        _feed(calibrator, drive, observer)
        yield calibrator
    finally:
        with observer.closing():
            calibrator.close()


def _feed(taker: Calibrator, drive: Recording, observer: Observer) -> None:
    count = drive.source.count
    observer.show('reading', None)
    for number, frame in enumerate(_read_ahead(drive.source), 1):
        if number == 1:
            check_mask(drive.mask, frame.size)
        taker.push(frame)
        observer.show('reading', min(number / count, 1.0) if count else None,
                      f'frame {number}, {counted(len(taker.detection.turns()), "turn")}')


def drive_motion(path: Paths, motion: str | os.PathLike[str] | None = None,
                 chosen: Mapping[str, str | None] = MappingProxyType({}),
                 topic: str | None = None, columns: Mapping[str, str] | None = None
                 ) -> SensorStream | None:
    """Return the sensors' data of the file motion, else of the bags; None if there is none.

    chosen: the bag's topics by imu, gps, odom and temperature; topic: its image topic. columns: of
    the file, as read_motion()'s. Raises InputError for a file of another kind, and for a topic
    that does not exist.
    """
    wanted = {name: topic for name, topic in chosen.items() if topic is not None}
    if motion is not None:
        if wanted:
            raise InputError('E-MOTION-TWICE', '--imu, --gps, --odom and --temperature choose '
                                               'topics of a bag: omit them or --motion')
        return read_motion(path_of(motion), columns)
    if columns:
        raise InputError('E-COLUMNS-WITHOUT-MOTION', '--columns names those of a CSV: add '
                                                     '--motion FILE')
    try:
        bags = [each for each in map(Path, as_list(path)) if each.exists() and fits_bag(each)]
        if not bags and 'temperature' in wanted:
            raise InputError('E-TEMPERATURE-MISSING', f'there is no file '
                             f'{wanted["temperature"]}, nor a bag with a topic of this name: '
                             f'check --temperature')
        return bag_motion(bags, wanted, topic) if bags else None
    except (InputError, OSError, ValueError):
        if wanted:
            raise
        return None  # reading the pictures will report what is wrong with the bag


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


def with_source(calibration: Calibration, source: FrameSource) -> Calibration:
    """Return the calibration with its input's name and warnings, its pictures in colour.

    What the input contradicts is the first reason of one that is not accepted: it may be why.
    """
    verdict, material, lost = calibration.verdict, calibration.material, list[Notice]()
    doubts = source.contradictions if verdict.level != 'accepted' else ()
    new = tuple(line for line in source.warnings
                if line not in (*doubts, *calibration.warnings))
    if doubts:
        verdict = replace(verdict, reasons=(*doubts, *verdict.reasons))
    if material is not None:
        coloured = spared('the pictures in colour', lost, _in_colour, material, source)
        material = coloured or material
    stored = calibration.camera and source.stored(calibration.camera)
    if stored:
        values = ', '.join(f'{name} {value:.2f}' for name, value in zip(
            ('fx', 'fy', 'cx', 'cy'), stored.params, strict=False))
        new += (Notice(
            'E-PIXELS-STORED', f'for the pictures as they are stored '
            f'({size_text(stored.image_size)}): {values}, and the same distortion'),)
    if source.part is not None:
        left, top, width, height = source.part
        new += (Notice(
            'E-PICTURE-PART', f'for the part {left},{top} to {left + width},{top + height} of the '
            f'pictures, whose corner is at (0, 0): cut them the same way before use; for whole '
            f'pictures add {left} to cx and {top} to cy'),)
    return replace(calibration, verdict=verdict, material=material, part=source.part,
                   input_name=calibration.input_name or source.name,
                   warnings=(*new, *calibration.warnings, *lost))


def _in_colour(material: Material, source: FrameSource) -> Material:
    shown = material.pictures
    images = source.in_colour({each.frame: each.stamp_ns for each in shown.values()})
    return replace(material, pictures={
        turn: each.coloured(images[each.frame]) if each.frame in images else each
        for turn, each in shown.items()})


# for Python ---------------------------------------------------------------------------------


class Calls(Observer):
    """Calls a function with each stage."""

    def __init__(self, progress: Progress | None) -> None:
        self._progress = progress

    def show(self, stage: str, share: float | None = None, note: str = '') -> None:
        """Call the function."""
        if self._progress is not None:
            self._progress(stage, share or 0.0)

    def __enter__(self) -> Calls:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.show('done', 1.0)


def settings_of(config: Settings, model: str | None) -> Config:
    """Return the settings, with another lens model. Raises ConfigError."""
    found = Config.of(config) if model is None else Config.of(config, model=model)
    searched(found.model)  # raises for an unknown model before any work begins
    return found


def calibrate(path: Paths, *, topic: str | None = None, fps: float | None = None,
              start_s: float = 0.0, duration_s: float | None = None, crop: Part | None = None,
              mask: MaskOrPath = None, motion: MotionOrPath = None,
              temperature: str | None = None, model: str | None = None,
              config: Settings = None, progress: Progress | None = None) -> Calibration:
    """Calibrate a recorded drive.

    path: a ROS 2 bag (folder, .mcap, .db3), a ROS 1 .bag, a video, a folder of images, or several
    of these of one camera (a sequence, a folder of videos, or a pattern such as 'clips/*.mp4').
    topic: the image topic of a bag; needed only when it has several.
    fps: images per second of a folder without times (default 10), or instead of a video's rate.
    start_s, duration_s: the part of the drive to use, in seconds; None: to its end.
    crop: (x, y, width, height) of the part of the pictures that is used, px, as one of two cameras
    side by side; the mask is of that part, and so is the camera.
    mask: the part of the pictures that is not used (bonnet, burnt-in text): the path of a picture
    that is black there, or an array (height, width) that is 0 or False there; it is added to the
    automatic mask.
    motion: data of the car's own sensors: the path of a CSV, a GPX file or a KITTI oxts folder, or
    a SensorStream. None: the topics of the bag, if path is one.
    temperature: of the camera, which its focal length may follow: the path of a CSV (stamp_s and
    temperature, in degrees Celsius), or a topic of the bag.
    model: the lens model, over that of config: radial, brown, fisheye, or auto.
    config: the settings: a Config, or a mapping such as {'turns.wanted': 8}; None: the defaults.
    progress: called with the name of a stage and its fraction done, 0 to 1; at last 'done', 1.0.

    Returns a Calibration: its verdict.level is 'accepted', 'weak' or 'refused', and its camera is
    None if it is refused; accepted() returns it, or raises. Raises InputError for input that
    cannot be read, ConfigError for a bad setting, WorkerError if a child process cannot run.
    """
    settings = settings_of(config, model)
    drive = open_drive(path, topic, fps, start_s, duration_s, mask, motion, crop=crop,
                       temperature=temperature)
    with Calls(progress) as observer:
        return calibrate_drive(drive, settings, observer)


def check(given: Given, path: Paths, *, topic: str | None = None, fps: float | None = None,
          start_s: float = 0.0, duration_s: float | None = None, crop: Part | None = None,
          mask: MaskOrPath = None, motion: MotionOrPath = None, model: str | None = None,
          config: Settings = None, progress: Progress | None = None) -> Check:
    """Check whether a calibration fits a recorded drive.

    given: the calibration: a Calibration, what load_camera() returns, the path of a file that it
    reads, or a Radial, Brown, Rational or Fisheye of the drive's pictures.
    path: a ROS 2 bag (folder, .mcap, .db3), a ROS 1 .bag, a video, a folder of images, or several
    of these of one camera (a sequence, a folder of videos, or a pattern such as 'clips/*.mp4').
    topic: the image topic of a bag; needed only when it has several.
    fps: images per second of a folder without times (default 10), or instead of a video's rate.
    start_s, duration_s: the part of the drive to use, in seconds; None: to its end.
    crop: (x, y, width, height) of the part of the pictures that is used, px, as one of two cameras
    side by side; the mask is of that part, and so is the camera.
    mask: the part of the pictures that is not used: the path of a picture that is black there, or
    an array (height, width) that is 0 or False there.
    motion: data of the car's own sensors: the path of a CSV, a GPX file or a KITTI oxts folder, or
    a SensorStream. None: the topics of the bag, if path is one.
    model: the lens model, over that of config: radial, brown, fisheye, or auto.
    config: the settings: a Config, or a mapping such as {'turns.wanted': 8}; None: the defaults.
    progress: called with the name of a stage and its fraction done, 0 to 1; at last 'done', 1.0.

    Returns a Check: its answer is 'right', 'differs' (good enough for the uses in its good_for),
    'wrong' or 'cannot tell', with reasons. Raises InputError for what cannot be read, ConfigError
    for a bad setting, WorkerError where a child process cannot run.
    """
    settings = settings_of(config, model)
    with in_order(given, path):
        drive = open_drive(path, topic, fps, start_s, duration_s, mask, motion, crop=crop)
        named = given_camera(given, drive.source.first_size)
    with Calls(progress) as observer:
        return check_drive(drive, named, settings, observer).check
