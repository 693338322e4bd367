# SPDX-License-Identifier: Apache-2.0
"""Recorded drives of several cameras of one car in, a rig out.

Each camera is calibrated alone. Then the stretches that cameras share are read once more, with the
lenses known: for the pose of every image, and for matches between cameras that see the same.
"""
from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from dashcalib_ros.arrays import Floats, Mask
from dashcalib_ros.camera.rotation import rotation_vectors
from dashcalib_ros.config import Config
from dashcalib_ros.errors import InputError, Notice
from dashcalib_ros.input import Frame
from dashcalib_ros.input.inputs import Paths
from dashcalib_ros.input.motion import Samples, speed_sigma, speeds_of
from dashcalib_ros.input.scale import Scale
from dashcalib_ros.judge.known import value_of
from dashcalib_ros.judge.mount import HEIGHT_FLOOR, log_height
from dashcalib_ros.pipeline import Calibrator
from dashcalib_ros.report import Calibration
from dashcalib_ros.rig.dense import Retraced, retraced
from dashcalib_ros.rig.joint import Matched, Solved
from dashcalib_ros.rig.paths import CameraPaths, camera_paths, coarse_paths, ordered
from dashcalib_ros.rig.placed import (
    Alone,
    RigCalibration,
    Witnessed,
    best_base,
    rig_of_paths,
)
from dashcalib_ros.rig.start import Aligned, Metres, aligned
from dashcalib_ros.rig.witness import (
    Epipolar,
    fitted,
    matched,
    rays_of,
    residual_over,
    rotation_by_matches,
    sees_alike,
)
from dashcalib_ros.session import (
    Calls,
    MotionOrPath,
    Observer,
    Recording,
    Settings,
    learned_drive,
    open_drive,
    settings_of,
    with_source,
)
from dashcalib_ros.solve.solution import Solution
from dashcalib_ros.workers.child import ChildWorker
from dashcalib_ros.workers.pool import ScenePool
from dashcalib_ros.workers.worker import Progress

# s between the images of a stretch whose poses are found: those of all cameras nearest to the
# same times are taken
GRID_S = 0.1
# pairs of images in which two cameras are matched, and s that these may be apart
PICTURES, TOGETHER_S = 12, 0.012
# s: so long before and after a stretch, the speed counts as unknown
NEXT_S = 1e-3
# sigmas of a rotation, and degrees, that the epipolar geometry of matches may be off
CONTRADICTED, LEAST_APART_DEG = 3.0, 0.15


@dataclass(frozen=True)
class Learned:
    """What one camera's drive gave. valid: where the ego vehicle is not, as resized."""

    drive: Recording
    calibration: Calibration
    solution: Solution | None
    scale: Scale
    valid: Mask | None

    @property
    def start_s(self) -> float:
        """Return the stamp of the first image."""
        return self.calibration.start_s


@dataclass(frozen=True)
class Rig:
    """A rig, and the calibration of each of its cameras."""

    rig: RigCalibration
    calibrations: Mapping[str, Calibration]


class _Named(Observer):
    """Shows the stages of one of several cameras."""

    def __init__(self, inner: Observer, name: str) -> None:
        self._inner, self._name = inner, name

    def show(self, stage: str, share: float | None = None, note: str = '') -> None:
        self._inner.show(f'{self._name}: {stage}', share, note)


def rig_of_drives(drives: Mapping[str, Recording], base: str | None = None,
                  config: Config | None = None, observer: Observer | None = None,
                  place: Callable[[str], str] = lambda name: f'{name}/result.json',
                  match: bool = False) -> Rig:
    """Calibrate the cameras of one car, and where each sits.

    drives: by the cameras' names. base: the name of the camera that the others are placed
    against; None: the first one whose lens is accepted. place: of a camera's result, for the file.
    match: use matches between cameras, too. known.height is that of the base, or of the first
    camera. Raises InputError.
    """
    config, observer = config or Config(), observer or Observer()
    if base not in (None, *drives) or len(drives) < 2:
        raise InputError('E-RIG-CAMERAS', f'a rig needs two cameras, and its base, {base}, is one '
                         f'of them: name them as front=front.mp4 left=left.mp4')
    measured, others = base or next(iter(drives)), config.replace({'known.height': ''})
    learned = {name: _learn(name, drive, config if name == measured and drive.motion else others,
                            observer) for name, drive in drives.items()}
    found = {name: coarse_paths(name, each.solution, each.start_s)
             for name, each in learned.items()}
    base = base or best_base({name: each.calibration.verdict.level
                              for name, each in learned.items()})
    turned = {name: aligned(found[name], found[base], _clock(learned, name, base))
              for name in drives if name != base}
    kept = {name: each for name, each in turned.items() if each is not None and each.found}
    observer.show('retracing the stretches that cameras share', None)
    again = _Again(learned, base, found, kept, config)
    again.read()
    with _workers(config, observer) as pool:
        paths = again.paths(pool, observer)
        matches = again.matches(pool)
    observer.show('placing the cameras', None)
    alone = {name: Alone(place(name), each.calibration.verdict.level, each.start_s,
                         len(found[name].scenes)) for name, each in learned.items()}
    mount = learned[base].calibration.mount
    metres = (_by_speed(learned, again.late)
              or _by_height(learned[measured], config, again.late.get(measured)))
    return Rig(rig_of_paths(alone, base, turned, paths, metres, config.rig,
                            lambda best, use: _witnessed(learned, best, matches,
                                                         match and use),
                            None if mount is None else mount.rotation),
               {name: each.calibration for name, each in learned.items()})


def _learn(name: str, drive: Recording, config: Config, observer: Observer) -> Learned:
    named = _Named(observer, name)
    try:
        with learned_drive(drive, config, named, False) as calibrator:
            calibration = with_source(calibrator.calibrate(named.show), drive.source)
            return _kept(drive, calibration, calibrator)
    except InputError as error:
        raise InputError(error.code, f'{name}: {error}') from error


def _kept(drive: Recording, calibration: Calibration, calibrator: Calibrator) -> Learned:
    return Learned(drive, calibration, calibrator.solution, calibrator.detection.scale,
                   calibrator.detection.valid())


def _clock(learned: Mapping[str, Learned], name: str, base: str) -> float:
    """Return how late a camera's stamps are if both have one clock, from their first images."""
    return learned[base].start_s - learned[name].start_s


@contextmanager
def _workers(config: Config, observer: Observer) -> Iterator[ScenePool]:
    pool = ScenePool(config, lambda: ChildWorker(False, False, config.workers, lambda text: None),
                     _load)
    pool.start()
    try:
        yield pool
    finally:
        with observer.closing():
            pool.close()


def _load() -> None:
    import dashcalib_ros.rig.dense  # noqa: F401


class _Again:
    """The second reading of the drives: the images of stretches that are shared.

    late: of the clocks of the cameras that are aligned, against the base's, s.
    """

    def __init__(self, learned: Mapping[str, Learned], base: str,
                 found: Mapping[str, CameraPaths], kept: Mapping[str, Aligned],
                 config: Config) -> None:
        self._learned, self._base, self._config = learned, base, config
        self.late = {base: 0.0} | {name: each.late_s for name, each in kept.items()}
        self._rotations = {base: np.eye(3)} | {
            name: each.rotation for name, each in kept.items()}
        spans = {name: [(scene.seconds[0] - late, scene.seconds[-1] - late)
                        for scene in found[name].scenes] for name, late in self.late.items()}
        others = {name: [span for other in spans if other != name
                         and self._base in (name, other) for span in spans[other]]
                  for name in spans}
        # the stretches of each camera that another one saw, too, and their images
        self._shared = {name: [n for n, own in enumerate(spans[name]) if any(
            min(own[1], other[1]) - max(own[0], other[0]) > 0.5 for other in others[name])]
            for name in spans}
        self._spans = spans
        self._frames: dict[tuple[str, int], dict[int, Frame]] = defaultdict(dict)

    def read(self) -> None:
        """Read the drives."""
        for name, late in self.late.items():
            each = self._learned[name]
            wanted = {n: self._spans[name][n] for n in self._shared[name]}
            last = max((end for _, end in wanted.values()), default=-np.inf)
            if not wanted:
                continue
            for frame in each.drive.source:
                seconds = frame.stamp_ns / 1e9 - each.start_s - late
                if seconds > last + GRID_S:
                    break
                key, small = round(seconds / GRID_S), None
                for n, (begin, end) in wanted.items():
                    if begin - 1e-6 <= seconds <= end + 1e-6:
                        before = self._frames[name, n].get(key)
                        if before is None or abs(seconds - key * GRID_S) < abs(
                                self._seconds(name, before) - key * GRID_S):
                            small = small or each.scale.frame(frame)
                            self._frames[name, n][key] = small

    def _seconds(self, name: str, frame: Frame) -> float:
        each = self._learned[name]
        return float(frame.stamp_ns / 1e9 - each.start_s - self.late[name])

    def paths(self, pool: ScenePool, observer: Observer) -> dict[str, CameraPaths]:
        """Return the paths of the cameras, with the pose of every image."""
        calls = {}
        for (name, n), frames in self._frames.items():
            each = self._learned[name]
            assert each.solution is not None
            scene = ordered(each.solution)[n]
            calls[name, n] = pool.begin(
                retraced, list(frames.values()), scene, each.solution, self._config, each.valid)
        stretches: dict[str, list[Retraced]] = {name: [] for name in self.late}
        for number, ((name, _), call) in enumerate(calls.items()):
            observer.show('retracing the stretches that cameras share', number / len(calls))
            stretch = pool.result(call)
            if stretch is not None:
                stretches[name].append(stretch)
        found = {}
        for name, theirs in stretches.items():
            each = self._learned[name]
            if each.solution is not None:
                found[name] = camera_paths(name, each.solution, theirs, each.start_s)
        return found

    def matches(self, pool: ScenePool) -> dict[tuple[str, str], list[tuple[Floats, Floats]]]:
        """Return the matches of cameras that see alike, at equal times."""
        images: dict[str, dict[int, Frame]] = defaultdict(dict)
        for (name, _), frames in self._frames.items():
            images[name] |= frames
        calls = {}
        for a, b in combinations(images, 2):
            cameras = [self._learned[name].solution for name in (a, b)]
            across = self._rotations[b] @ self._rotations[a].T
            if any(each is None for each in cameras) or not sees_alike(
                    cameras[0].camera, cameras[1].camera, across):  # type: ignore[union-attr]
                continue
            both = [key for key in sorted(images[a].keys() & images[b].keys()) if abs(
                self._seconds(a, images[a][key]) - self._seconds(b, images[b][key])) < TOGETHER_S]
            some = sorted({both[int(n)] for n in np.linspace(0, len(both) - 1, PICTURES)}
                          if both else set())
            calls[a, b] = [pool.begin(matched, images[a][key].image, images[b][key].image)
                           for key in some]
        return {pair: [pool.result(call) for call in each] for pair, each in calls.items()}


def _witnessed(learned: Mapping[str, Learned], best: Solved,
               matches: Mapping[tuple[str, str], Sequence[tuple[Floats, Floats]]], use: bool
               ) -> Witnessed:
    """Return what cameras see together. use: what contradicts no place is an observation."""
    found: dict[tuple[str, str], Epipolar] = {}
    doubts: dict[str, tuple[Notice, ...]] = {}
    used: list[Matched] = []
    for (a, b), pairs in matches.items():
        if not pairs or not {a, b} <= best.problem.places.keys():
            continue
        solutions = [solution for name in (a, b) if (solution := learned[name].solution)]
        cameras = [solution.camera for solution in solutions]
        fields = [solution.field for solution in solutions]
        rays, xy = rays_of(cameras, pairs, fields)
        across = best.problem.places[b].rotation @ best.problem.places[a].rotation.T
        scale = learned[a].scale.px
        held = fitted(rays, across, cameras[0].fx)
        lenses = [best.problem.cameras[name].lens_covariance for name in (a, b)]
        shown = rotation_by_matches((a, b), [each.widened() for each in cameras], pairs, fields,
                                    across, [np.sqrt(np.diag(lens)) for lens in lenses])
        # cameras that see hardly anything in common have matches by chance
        if held is None or shown is None:
            continue
        seen = residual_over(cameras[0], xy, held)
        found[a, b] = replace(seen, median=seen.median * scale, cells_rms=seen.cells_rms * scale)
        if degrees := _contradicted(shown, across, best):
            for name in {a, b} - {best.problem.base}:
                doubts[name] = (*doubts.get(name, ()), Notice(
                    'E-RIG-EPIPOLAR', f'{name}: matches between {a} and {b} say that one is '
                    f'turned by {degrees:.2f} degrees more against the other: check that none was '
                    f'moved during the drive, or drive more turns'))
        elif use:
            used.append(shown)
    return Witnessed(found, doubts, tuple(used))


def _contradicted(shown: Matched, across: Floats, best: Solved) -> float:
    """Return by how many degrees matches contradict a rotation; 0 where they do not.

    What the lenses may be off belongs to both.
    """
    away = rotation_vectors((shown.rotation @ across.T)[None])[0]
    variance = np.diag(shown.covariance).copy()
    for name in (shown.a, shown.b):
        follow = shown.follow[name]
        variance += np.diag(follow @ best.problem.cameras[name].lens_covariance @ follow.T)
        if name != best.problem.base:
            variance += best.sigma(name)[:3]**2
    beyond = np.abs(away) > np.maximum(
        CONTRADICTED * np.sqrt(variance), np.radians(LEAST_APART_DEG))
    return float(np.degrees(np.linalg.norm(away))) if beyond.any() else 0.0


def _by_speed(learned: Mapping[str, Learned], late: Mapping[str, float]) -> Metres | None:
    """Return the metres by the speed of the car, where a drive has one.

    late: of clocks, the base's first.
    """
    for name, offset in late.items():
        each = learned[name]
        motion = each.drive.motion
        speed = motion and speeds_of(motion.since(each.start_s))
        if motion and speed:
            return Metres.by(speed, offset, speed_sigma(motion))
    return None


def _by_height(camera: Learned, config: Config, late: float | None) -> Metres | None:
    """Return the metres by the known height of a camera above the road; None: nothing known.

    late: of its clock; None where it is not aligned with the base.
    """
    mount, times, speeds = camera.calibration.mount, list[Floats](), list[Floats]()
    if not config.known.height or mount is None or camera.solution is None or late is None:
        return None
    height, sigma = value_of(config.known.height, 'height')
    for scene in ordered(camera.solution):
        found = log_height(scene, -mount.rotation[2])
        seconds = scene.tracks.stamps_ns[scene.structure.registered] / 1e9 - camera.start_s
        # turns may overlap
        if found is not None and (not times or seconds[0] - NEXT_S > times[-1][0]):
            ways = np.linalg.norm(np.diff(scene.structure.path()[1], axis=0), axis=1)
            speed = ways / np.diff(seconds) * height / np.exp(found[0])
            # nothing is known between stretches
            times += [seconds[:1] - NEXT_S, seconds[:1], (seconds[1:] + seconds[:-1]) / 2,
                      seconds[-1:], seconds[-1:] + NEXT_S]
            speeds += [np.zeros(1), speed[:1], speed, speed[-1:], np.zeros(1)]
    if not times:
        return None
    return Metres.by(Samples(np.concatenate(times), np.concatenate(speeds)[:, None]), late,
                     float(np.hypot(sigma / height, HEIGHT_FLOOR)))


# for Python ---------------------------------------------------------------------------------


def calibrate_rig(drives: Mapping[str, Paths | Recording], *, base: str | None = None,
                  fps: float | None = None, motion: MotionOrPath = None, match: bool = False,
                  config: Settings = None, progress: Progress | None = None) -> Rig:
    """Calibrate several cameras of one car from one drive, and where each sits.

    drives: by the cameras' names: a bag, a video, a folder of images, or several files of one
    drive; 'BAG:TOPIC' for one topic of a bag. Every camera may have its own size, rate, lens,
    shutter and clock.
    base: the camera that the others are placed against; None: the first one with the best lens.
    fps: images per second of a folder without times, or instead of a video's rate.
    config: the settings: a Config, or a mapping such as {'turns.wanted': 8}; None: the defaults.
    motion: data of the car's own sensors on the clock of the base, or of the first camera: the
    path of a CSV, a GPX file or a KITTI oxts folder, or a stream; with a speed translations are in
    metres.
    progress: called with the name of a stage and its fraction done, 0 to 1; at last 'done', 1.0.
    match: use what two cameras see at the same time, too, not only as a witness.

    Returns a Rig: its rig has a PlacedCamera for each name, with a verdict for each degree of
    freedom; its calibrations have what each camera says alone. Raises InputError
    for input that cannot be read, ConfigError for a bad setting, WorkerError if a child process
    cannot run.
    """
    settings = settings_of(config, None)
    clock = base or next(iter(drives), '')
    opened = {name: path if isinstance(path, Recording) else open_camera(
        path, fps, motion if name == clock else None) for name, path in drives.items()}
    with Calls(progress) as observer:
        return rig_of_drives(opened, base, settings, observer, match=match)


def open_camera(path: Paths, fps: float | None = None, motion: MotionOrPath = None) -> Recording:
    """Open one camera's drive. path: also PATH:TOPIC."""
    topic = None
    if isinstance(path, str) and not Path(path).exists() and ':' in path:
        before, _, after = path.rpartition(':')
        if Path(before).exists():
            path, topic = before, after
    return open_drive(path, topic, fps, motion=motion)
