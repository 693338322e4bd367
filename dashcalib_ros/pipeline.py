# SPDX-License-Identifier: Apache-2.0
"""The whole story: frames -> turns -> scenes -> one camera -> verdict."""
from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import TracebackType
from typing import Any

from dashcalib_ros import judge
from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera, searched
from dashcalib_ros.config import Config
from dashcalib_ros.detect import Turn, TurnId
from dashcalib_ros.detect.detection import Detection
from dashcalib_ros.errors import InputError, Notice, spared
from dashcalib_ros.input import Frame
from dashcalib_ros.input.decode import mask_of
from dashcalib_ros.input.motion import Samples, SensorStream
from dashcalib_ros.input.poses import Poses
from dashcalib_ros.input.source import size_text
from dashcalib_ros.judge import CalibrationData, Check, Monitor, Odometry, Reading, Verdict
from dashcalib_ros.judge.agreement import contradicting_turns, turns_of_earlier_cameras
from dashcalib_ros.judge.check import CALIBRATION
from dashcalib_ros.judge.conclude import (
    Evidence,
    conclude,
    evidence_of_detection,
    outlook,
    turns_that_stood,
)
from dashcalib_ros.judge.monitor import readings_of
from dashcalib_ros.judge.witnesses import SensorComparison, clock_of_poses, compare_sensors
from dashcalib_ros.reconstruct.repeated import without_repeated
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.report import Calibration
from dashcalib_ros.report.turns import direction
from dashcalib_ros.selection import SceneSelection
from dashcalib_ros.solve import solve
from dashcalib_ros.solve.solution import Solution
from dashcalib_ros.workers.child import ChildWorker
from dashcalib_ros.workers.memory import in_a_file
from dashcalib_ros.workers.pool import ScenePool
from dashcalib_ros.workers.worker import InlineWorker, Progress, Worker, WorkerDiedError


@dataclass(frozen=True)
class Status:
    """The calibrator's state after a frame.

    frames: pushed so far. turns: in the bank and stored. built: how many turns' scenes a
    calibration would use now; ready: these turns; yaw_deg: the sum of their yaw. stretches: of
    the drive besides that it would use; bends: how many of these have yaw. stored: how many turns
    are of earlier drives. magnitude: the newest filtered turning magnitude, of the image width.
    yaws_deg: of the turns in ready, in their order; ways: where these go, as direction() says.
    reconstructed: the turns that watch() has scenes of, chosen or not. two_cameras: what the
    newest images show, if they are of two.
    """

    frames: int
    turns: int
    built: int
    yaw_deg: float
    magnitude: float
    standing: bool
    ready: tuple[TurnId, ...] = ()
    stored: int = 0
    yaws_deg: tuple[float, ...] = ()
    reconstructed: tuple[TurnId, ...] = ()
    two_cameras: str = ''
    ways: tuple[str, ...] = ()
    stretches: tuple[TurnId, ...] = ()
    bends: int = 0


# degrees of yaw; what has less is straight on
BEND_DEG = 3.0


@dataclass(frozen=True)
class Outlook:
    """The turns of a drive, and what a calibration of it can come to at best.

    turns: of this drive, the best first. yaws_deg: of the turns that a calibration would use, by
    their ids, those of earlier drives too. verdict: accepted where their number and their angles
    are enough; their pictures decide the rest. start_s: stamp of the first image.
    """

    frames: int
    turns: tuple[Turn, ...]
    yaws_deg: Mapping[TurnId, float]
    verdict: Verdict
    warnings: tuple[Notice, ...]
    start_s: float


class Calibrator:
    """Learns a camera from the turns of a drive.

    push() the frames as they come; calibrate() when enough turns have gathered, or at the end.
    close() ends the child processes; a Calibrator is also a context manager. check(), odometry(),
    watch() and moved() ask the turns about other cameras than their own, of full-size pictures.
    All methods are for one thread, but close(), which is for any.

    detection: what was found in the frames so far: turns, tracked points, the ego vehicle. scenes:
    which turns are reconstructed, and which of them count. workers: where every stage after the
    detection runs. solution: what the last calibrate() judged, in the resized pictures' pixels;
    None before, and where there is none.
    """

    def __init__(self, config: Config | Mapping[str, Any] | None = None, mask: Any = None,
                 verbose: bool = False, live: bool = False, use_stored: bool = True,
                 warn: Callable[[Notice], None] = lambda notice: None, inline: bool = False,
                 on_trouble: Callable[[str], None] = lambda text: None,
                 on_wait: Callable[[], bool] | None = None) -> None:
        """config, mask: as for calibrate().

        live: children run at low priority, and push() never waits for them; offline it does, so
        that few turns are in memory at a time. use_stored: False does not load the turns in
        turns.store, but adds to them. warn: called with one line for each problem with
        turns.store; the result's warnings have them, too. inline: everything runs in this process,
        with equal results; numpy must have one thread, else WorkerError says how; close() then
        does not end what runs. on_trouble: called with one line for each child that died or hangs,
        and for each turn that is tried again after that, from any thread. on_wait: called again
        and again while a worker is waited for; it may push() a frame, so that a live drive goes
        on, and returns whether it did something. Raises ConfigError, InputError.
        """
        config, mask = Config.of(config), mask_of(mask)
        searched(config.model)
        self.solution: Solution | None = None
        self._live = live
        self._motion: SensorStream | None = None
        self._warmth: SensorStream | None = None
        # what the calibration under way has to do without
        self._lost: list[Notice] = []
        self._detect_s = 0.0
        self._started = time.monotonic()
        # what turns say of the camera that watch() was asked about last, resized
        self._watched: Camera | None = None
        self._readings: dict[TurnId, Reading] = {}

        def child() -> Worker:
            return ChildWorker(live, verbose, config.threads, on_trouble)

        def lost(notice: Notice) -> None:
            self.scenes.warnings.append(notice)
            on_trouble(notice)

        if live:
            # nothing else runs during an import: while images come, some would be lost
            _load_judging()
        self.detection = Detection(config, mask, beside=not live,
                                   keep=None if live else in_a_file)
        self.workers = ScenePool(config, InlineWorker if inline else child,
                                 partial(_load_all if live else _load_solving,
                                         config.reconstruct.used),
                                 queue=config.turns.wanted if live else None, on_lost=lost,
                                 on_trouble=on_trouble, keep_pictures=not live, on_wait=on_wait)
        self.scenes = SceneSelection(config, self.detection, self.workers, live, use_stored, warn)

    def push(self, frame: Frame) -> Status:
        """Take the next frame; raises InputError when its size differs from the first one's."""
        started = time.monotonic()
        new_turns = self.detection.push(frame)  # frames -> turns
        if self.detection.frames == 1:
            self.scenes.load(frame.frame_id)
        if new_turns:
            self.scenes.submit(more_to_come=True)  # turns -> scenes, in the background
        self._detect_s += time.monotonic() - started
        if self._live:
            self.scenes.submit_stretch()
        self.scenes.make_room()
        return self.status()

    def sense(self, motion: SensorStream, warmth: SensorStream | None = None) -> None:
        """Take what the car's sensors say of the drive so far, in the place of what came before.

        The next calibrate() uses it; its stamps count from the first image. warmth: with the
        temperature, where that is not in motion.
        """
        self._motion, self._warmth = motion, warmth

    def calibrate(self, progress: Progress | None = None, final: bool = True) -> Calibration:
        """Adjust the best turns' scenes together and judge the result.

        final: the drive is over, and its last turn may end here; no push() may follow.
        progress: called with the stage's name and the share done.
        """
        progress = progress or (lambda stage, done: None)
        started = time.monotonic()
        if final:
            self.detection.finish()
        found = self._calibrate(progress, final, started)
        if found.verdict.level == 'weak' and self.scenes.widen():
            found = self._calibrate(progress, final, started)  # with more turns
        return found

    def outlook(self, progress: Progress | None = None) -> Outlook:
        """Reconstruct the best turns, as calibrate() does, and say whether they are enough.

        The drive is over: no push() may follow.
        """
        self.detection.finish()
        scenes = self.scenes.wanted(progress or (lambda stage, done: None), final=True)
        evidence = self._evidence(time.monotonic(), SensorComparison())
        return Outlook(self.detection.frames, self.turns(),
                       {scene.turn: scene.yaw_deg for scene in scenes},
                       outlook(scenes, evidence, self.scenes.config.verdict),
                       evidence.warnings, self.detection.start_s)

    def close(self) -> None:
        """End threads and child processes; a calibrate() elsewhere raises WorkerError."""
        self.detection.close()
        self.workers.close()

    def _calibrate(self, progress: Progress, final: bool, started: float) -> Calibration:
        self._lost = []
        scenes, solution = self._solve(progress, final)  # scenes -> one camera
        sensors = self._compare_sensors(solution, progress)
        solution = sensors.solution
        # these do not count in the next calibration; files of another camera's turns stay
        self.scenes.exclude(turns_of_earlier_cameras(scenes, solution), keep_files=True)
        self.scenes.exclude(contradicting_turns(scenes, solution))
        self.solution = solution
        return self._judge(sensors, started)  # one camera -> verdict

    def _solve(self, progress: Progress, final: bool) -> tuple[list[Scene], Solution | None]:
        config = self.scenes.config
        while scenes := self.scenes.wanted(progress, final):
            stood = spared('what the speed says of the turns', self._lost, turns_that_stood,
                           scenes, self._motion, self.detection.start_s)
            if stood:
                self.scenes.exclude(stood)
                continue
            # the search for repeated pictures takes a second and hardly ever finds some
            search = self.workers.begin(without_repeated, scenes)
            warm = spared('the temperature', self._lost, self._temperature)
            solving = self.workers.begin(solve, scenes, config, warm, reports=True)
            kept, repeated = self.workers.result(search)
            if repeated:
                self.workers.drop(solving)
                self.scenes.exclude_repeated(repeated)
                continue
            if any(len(one.tracks.frames) < len(other.tracks.frames)
                   for one, other in zip(kept, scenes, strict=True)):
                self.workers.drop(solving)
                solving = self.workers.begin(solve, kept, config, warm, reports=True)
            return kept, self.workers.result(solving, progress)
        return [], None

    def _temperature(self) -> Samples | None:
        """Return the temperature on the images' clock; None where nobody measured it."""
        start_s = self.detection.start_s
        found = [samples for stream in (self._warmth, self._motion) if stream is not None
                 and (samples := stream.since(start_s).temperature) is not None]
        return Samples(found[0].stamps_s + start_s, found[0].values) if found else None

    def _compare_sensors(self, solution: Solution | None, progress: Progress
                         ) -> SensorComparison:
        if self._motion is None:
            return SensorComparison(solution)
        progress('evaluating the motion sensors', 0.0)
        found: SensorComparison | None = spared(
            'the comparison with the motion sensors', self._lost, self.workers.run,
            compare_sensors, solution, self._motion, self.detection.start_s, self.scenes.config)
        if self.workers.closed:
            raise WorkerDiedError('E-CALIBRATOR-CLOSED', 'the calibrator is closed')
        return found or SensorComparison(solution)

    def _judge(self, sensors: SensorComparison, started: float) -> Calibration:
        # the solution itself is judged
        evidence = self._evidence(started, replace(sensors, solution=None))
        what = self.solution, evidence, self.scenes.config
        # it takes a second or two, and a live drive goes on meanwhile
        return Calibration.of(conclude(*what) if not self._live or self.solution is None
                              else self.workers.run(conclude, *what))

    def _evidence(self, started: float, sensors: SensorComparison) -> Evidence:
        now = time.monotonic()
        timing = {'detect': self._detect_s, 'calibrate': now - started,
                  'total': now - self._started}
        seen = evidence_of_detection(self.detection, self.scenes.built())
        return replace(
            seen, timing=timing,
            warnings=(*seen.warnings, *self.scenes.warnings, *self._lost, *(
                self._warmth.since(seen.start_s).warnings if self._warmth else ())),
            stored=self.scenes.stored_before, left_out=self.scenes.left_out(),
            pictures=None if self._live else self.workers.pictures(), motion=self._motion,
            sensors=sensors, temperature=spared('the temperature', [], self._temperature))

    # other cameras ----------------------------------------------------------------------------

    def check(self, given: Camera, calibration: CalibrationData, progress: Progress | None = None,
              name: str = CALIBRATION) -> Check:
        """Say whether a given camera explains the drive.

        calibration: what the last calibrate() returned. progress: as for calibrate(). name: of
        the given camera's file, for the command that a message offers.
        """
        if progress is not None:
            progress('the turns with the given camera', 0.0)
        config, size = self.scenes.config, calibration.image_size
        found: Check = self.workers.run(judge.check, given, size, self.solution,
                                        calibration.verdict, config, name)
        return judge.with_lines(found, given, self.detection.lines(), size, config)

    def odometry(self, given: Camera, poses: Poses, progress: Progress | None = None
                 ) -> Odometry | None:
        """Compare the motion that cameras find in the turns with true poses.

        The cameras: given, the drive's own, and a trivial guess. Returns None where the last
        calibrate() found no camera. Raises InputError where given is for pictures of another size,
        or no turn has poses.
        """
        if self.solution is None:
            return None
        if progress is not None:
            progress('the turns beside the poses', 0.0)
        own = self.solution.camera
        cameras = {'given': self._resized(given), 'ours': own,
                   'guess': judge.trivial_guess(own.image_size)}
        found: Odometry = self.workers.run(judge.odometry, self.solution.scenes, cameras, poses,
                                           self.scenes.config)
        # a track has the headings of its way, which are not the car's
        clock = None if poses.of_track else spared(
            'the clock of the poses', [], self.workers.run, clock_of_poses, self.solution, poses,
            self.scenes.config)
        return replace(found, clock=clock)

    def watch(self, camera: Camera, sigma: Mapping[str, float] | None = None) -> Monitor:
        """Return whether the turns so far show that a camera in use has changed.

        sigma: of its parameters; None for a camera that is not known to have fitted any turns
        before these: then only turns behind one that it explains can show a change. Turns that
        were read with the same camera before are not read again. Raises InputError where the
        camera is for pictures of another size.
        """
        small, config = self._resized(camera), self.scenes.config
        scenes = {scene.turn: scene for scene in self.scenes.turns_of(
            self.scenes.all_scenes().values())}
        if self._watched != small:
            self._watched, self._readings = small, {}
        new = [scene for turn, scene in scenes.items() if turn not in self._readings]
        if new:
            readings: tuple[Reading, ...] = self.workers.run(readings_of, new, small, config)
            self._readings |= {reading.turn: reading for reading in readings}
        units = dict(zip(small.names(), small.units(self.detection.scale.px).tolist(),
                         strict=True))
        scaled = None if sigma is None else {
            name: value / units.get(name, 1.0) for name, value in sigma.items()}
        # a stored turn that was driven again counts once
        return judge.watch((reading for turn, reading in sorted(self._readings.items())
                            if turn.of_this_drive or turn in scenes), small, scaled,
                           config.monitor)

    def moved(self, camera: Camera, newest: int) -> tuple[float, Floats] | None:
        """Return when and by how much the camera was moved on the car; None where it was not.

        That is s before the newest image, and (2,) degrees to the left and upwards. newest: pairs
        of images of straight driving that are asked. Raises InputError as watch() does.
        """
        straights = self.detection.straights(newest)
        found = self.workers.run(judge.moved, straights, self._resized(camera))
        return found and (float(straights.stamps_s[-1] - found[0]), found[1])

    def _resized(self, camera: Camera) -> Camera:
        size, scale = self.detection.size, self.detection.scale
        if camera.image_size != size:
            raise InputError('E-CALIBRATION-SIZE',
                             f'the given camera is for pictures of another size: '
                             f'{size_text(camera.image_size)}; resize it with dashcalib export '
                             f'--size')
        return camera.resized(1 / scale.px, scale.size(size))

    # what is known so far ---------------------------------------------------------------------

    def turns(self) -> tuple[Turn, ...]:
        """Return the bank's turns, the most prominent first."""
        return self.detection.turns()

    def status(self) -> Status:
        """Return the present state; scenes that are new are written to turns.store.

        Those of a drive of two cameras are not.
        """
        found = self.detection
        self.scenes.store_new()
        used, stored = self.scenes.chosen(), len(self.scenes.stored())
        chosen = self.scenes.turns_of(used)
        turns = {scene.turn for scene in chosen}
        further = [scene for scene in used if scene.turn not in turns]
        return Status(found.frames, len(found.turns()) + stored, len(chosen),
                      sum(scene.yaw_deg for scene in chosen), found.magnitude,
                      found.standing, tuple(scene.turn for scene in chosen), stored,
                      tuple(scene.yaw_deg for scene in chosen),
                      tuple(scene.turn for scene in self.scenes.turns_of(
                          self.scenes.all_scenes().values())),
                      str(found.other_camera) if found.mixed else '',
                      tuple(map(direction, chosen)),
                      tuple(scene.turn for scene in further),
                      sum(scene.yaw_deg >= BEND_DEG for scene in further))

    def __enter__(self) -> Calibrator:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.close()


def _load_solving(engine: str) -> None:
    """Import what a worker needs until the solution, the engine too."""
    import dashcalib_ros.solve.joint  # noqa: F401
    from dashcalib_ros.reconstruct import load
    load(engine)


def _load_judging() -> None:
    """Import what judges a result, and what that may need: it takes half a second."""
    from scipy import optimize, special  # noqa: F401
    from scipy.spatial import transform  # noqa: F401

    import dashcalib_ros.judge.conclude  # noqa: F401


def _load_all(engine: str) -> None:
    """Import what a worker of a live drive needs until the result."""
    _load_judging()
    _load_solving(engine)
