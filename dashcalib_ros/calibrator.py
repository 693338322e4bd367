"""The complete calibration: detect turns, reconstruct each, solve for one camera, judge it.

The stages are in stages.py; the Calibrator decides only what runs when.
"""
from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Set
from dataclasses import dataclass, replace
from types import TracebackType

from dashcalib_ros import stages
from dashcalib_ros.arrays import Mask
from dashcalib_ros.camera import Camera, searched
from dashcalib_ros.config import Config
from dashcalib_ros.detect import Turn, TurnId
from dashcalib_ros.detect.detection import Detection
from dashcalib_ros.errors import InputError
from dashcalib_ros.input import Frame
from dashcalib_ros.input.motion import SensorStream
from dashcalib_ros.judge import (
    Check,
    Monitor,
    Odometry,
    Poses,
    Reading,
    watch,
    with_lines,
)
from dashcalib_ros.judge.agreement import earlier_of_another_camera, evidence_of
from dashcalib_ros.judge.conclude import CONTRADICTS, Evidence, evidence_of_detection
from dashcalib_ros.judge.witnesses import Asked
from dashcalib_ros.report import Calibration
from dashcalib_ros.selection import Progress, SceneSelection
from dashcalib_ros.solve.solution import Solution
from dashcalib_ros.status import Status, View


@dataclass(frozen=True)
class _Read:
    """What turns say of a camera in use, which is of the resized pictures; added to."""

    camera: Camera
    turns: dict[TurnId, Reading]


class Calibrator:
    """Learns a camera from the turns of a drive.

    push() the frames as they come; calibrate() when enough turns have gathered, or at the end.
    close() ends the child processes; a Calibrator is also a context manager. All methods are for
    one thread, but close() and child_pids(), which are for any.
    """

    def __init__(self, config: Config | None = None, mask: Mask | None = None,
                 verbose: bool = False, live: bool = False, use_stored: bool = True,
                 warn: Callable[[str], None] = lambda text: None, inline: bool = False,
                 on_trouble: Callable[[str], None] = lambda text: None,
                 on_wait: Callable[[], bool] | None = None) -> None:
        """mask: (h, w), False where the ego vehicle is.

        live: children run at low priority, and push() never waits for them; offline it does, so
        that few turns are in memory at a time. use_stored: False does not load the turns in
        turns.store, but adds to them. warn: called with one line for each problem with
        turns.store; the result's warnings have them, too. inline: everything runs
        in this process, with equal results; numpy must have one thread, else WorkerError says how;
        close() then does not end what runs. on_trouble: called with one line for each child that
        died or hangs, and for each turn that is tried again after that, from any thread. on_wait:
        called again and again while calibrate(), check() or watch() waits for a worker; it may
        push() a frame, so that a live drive goes on, and returns whether it did something.
        """
        self._config = config or Config()
        searched(self._config.model)  # raises ConfigError for one that there is not
        self._detection = Detection(self._config, mask)
        self._scenes = SceneSelection(self._config, self._detection, live, verbose, use_stored,
                                      warn, inline, on_trouble, on_wait)
        self._live = live
        self._solution: Solution | None = None
        self._read: _Read | None = None
        self._motion: SensorStream | None = None
        self._detect_s = 0.0
        self._started = time.monotonic()

    def push(self, frame: Frame) -> Status:
        """Take the next frame; raises InputError when its size differs from the first one's."""
        started = time.monotonic()
        new = self._detection.push(frame)
        if self._detection.frames == 1:
            self._scenes.load(frame.frame_id)
        if new:
            self._scenes.submit(more_to_come=True)
        self._detect_s += time.monotonic() - started
        self._scenes.make_room()
        return self.status()

    def sense(self, motion: SensorStream) -> None:
        """Take what the car's sensors say of the drive so far, in the place of what came before.

        The next calibrate() asks it; its stamps count from the first image.
        """
        self._motion = motion

    def calibrate(self, progress: Progress | None = None, final: bool = True) -> Calibration:
        """Adjust the best turns' scenes together and judge the result.

        final: the drive is over, and its last turn may end here; no push() may follow.
        progress: called with the stage's name and the share done.
        """
        tell = progress or (lambda stage, done: None)
        if final:
            self._detection.finish()
        self._scenes.submit()
        started = time.monotonic()
        calibration = self._solve_and_judge(tell, final, started)
        # a weak result is calculated again with more turns
        if calibration.verdict.level == 'weak' and self._scenes.widen():
            calibration = self._solve_and_judge(tell, final, started)
        return calibration

    def _solve_and_judge(self, tell: Progress, final: bool, started: float) -> Calibration:
        """Return the calibration from the turns that are selected now."""
        tell('reconstructing turns', 0.0)
        scenes = self._scenes.wanted(tell, final)
        solution: Solution | None = None
        asked = Asked()
        if scenes:
            if self._motion is None:
                solution = self._scenes.run(stages.solve, scenes, self._config, progress=tell)
            else:
                asked = self._scenes.run(stages.solve_with_sensors, scenes, self._config,
                                         self._motion, self._detection.start_s, progress=tell)
                solution = asked.solution
            contradicted = earlier_of_another_camera(scenes, solution)
            self._scenes.leave_out(contradicted)
            self._scenes.reject(dict.fromkeys(
                {scene.turn for scene in scenes} - evidence_of(solution, self._config.verdict)
                - contradicted, CONTRADICTS))
        self._solution = solution
        # the solution itself is judged
        evidence = replace(self._evidence(started), motion=self._motion,
                           asked=replace(asked, solution=None))
        if not self._live or solution is None:
            return stages.judge(solution, evidence, self._config)
        # it takes a second or two, and a live drive goes on meanwhile
        found: Calibration = self._scenes.run(stages.judge, solution, evidence, self._config)
        return found

    def _evidence(self, started: float) -> Evidence:
        now = time.monotonic()
        timing = {'detect': self._detect_s, 'calibrate': now - started,
                  'total': now - self._started}
        return evidence_of_detection(
            self._detection, self._scenes.built(), timing, tuple(self._scenes.warnings),
            self._scenes.stored_before(), self._scenes.left_out(),
            None if self._live else self._scenes.pictures())

    def check(self, given: Camera, calibration: Calibration, progress: Progress | None = None
              ) -> Check:
        """Say whether a given camera explains the drive.

        given: of the full-size pictures. calibration: what the last calibrate() returned.
        progress: as for calibrate().
        """
        found: Check = self._scenes.run(
            stages.check, given, calibration.image_size, self._solution, calibration.verdict,
            self._config, progress=progress or (lambda stage, done: None))
        lines = self._detection.lines()
        return with_lines(found, given, lines, calibration.image_size, self._config)

    def odometry(self, given: Camera, calibration: Calibration, poses: Poses,
                 progress: Progress | None = None) -> Odometry | None:
        """Compare the motion that cameras find in the turns with true poses.

        The cameras: given, the drive's own, and a trivial guess. given, calibration: as for
        check(). Returns None where the drive has no camera of its own. Raises InputError where
        given is for pictures of another size, or no turn has poses.
        """
        if self._solution is None:
            return None
        found: Odometry = self._scenes.run(
            stages.odometry, given, calibration.image_size, self._solution, poses, self._config,
            progress=progress or (lambda stage, done: None))
        return found

    def watch(self, camera: Camera, sigma: Mapping[str, float] | None = None,
              progress: Progress | None = None) -> Monitor:
        """Return whether the turns so far show that a camera in use has changed.

        camera: of the full-size pictures. sigma: of its parameters; None for a camera that is not
        known to have fitted any turns before these: then only turns behind one that it explains
        can show a change. Turns that were read with the same camera before are not read again.
        progress: as for calibrate(). Raises InputError where the camera is for pictures of
        another size.
        """
        size, scale = self._detection.size, self._detection.scale
        scenes = self._scenes.all_scenes()
        if camera.image_size != size:
            raise InputError(f'the camera in use is for pictures of another size: '
                             f'{camera.image_size[0]}x{camera.image_size[1]}')
        small = camera.resized(1 / scale.px, scale.size(size))
        if self._read is None or self._read.camera != small:
            self._read = _Read(small, {})
        turns = self._read.turns
        new = [scene for turn, scene in scenes.items() if turn not in turns]
        if new:
            readings: tuple[Reading, ...] = self._scenes.run(
                stages.read, new, small, self._config,
                progress=progress or (lambda stage, done: None))
            turns |= {reading.turn: reading for reading in readings}
        # fx, fy, cx and cy are pixels
        scaled = None if sigma is None else {
            name: value / scale.px if name in small.names()[:4] else value
            for name, value in sigma.items()}
        # a stored turn that was driven again counts once
        return watch((turns[turn] for turn in sorted(turns)
                      if turn.of_this_drive or turn in scenes), small, scaled,
                     self._config.monitor)

    @property
    def solution(self) -> Solution | None:
        """Return what the last calibrate() judged, in the resized pictures' pixels."""
        return self._solution

    def turns(self) -> tuple[Turn, ...]:
        """Return the bank's turns, the most prominent first."""
        return self._detection.turns()

    def status(self) -> Status:
        """Return the present state; scenes that are new are written to turns.store."""
        self._scenes.store_new()
        chosen, stored = self._scenes.chosen(), len(self._scenes.stored())
        found = self._detection
        return Status(found.frames, len(found.turns()) + stored, len(chosen),
                      sum(scene.yaw_deg for scene in chosen), found.magnitude,
                      found.standing, tuple(scene.turn for scene in chosen), stored,
                      tuple(scene.yaw_deg for scene in chosen),
                      tuple(self._scenes.all_scenes()))

    def view(self) -> View:
        """Return what is tracked and masked in the newest frame."""
        return View(self._detection.points(), self._detection.valid())

    def want(self, turns: int, more: int = 0) -> None:
        """Use so many turns from the next calibration on, turns.capacity at the most.

        more: turns of this drive are used beyond those.
        """
        self._scenes.more = more
        if turns != self._config.turns.wanted:
            self._config = self._config.replace({'turns.wanted': turns})
            self._scenes.want(turns)

    def reject(self, turns: Iterable[TurnId]) -> None:
        """Take turns out that are not of the present camera."""
        self._scenes.reject(dict.fromkeys(turns, CONTRADICTS))

    def forget_stored(self, but: Set[TurnId] = frozenset()) -> None:
        """Drop the turns of earlier drives but these, also on disk: for a camera that changed."""
        self._scenes.forget_stored(but)

    def clear_store(self) -> None:
        """Remove all turns of this calibrator from turns.store; it stores no others."""
        self._scenes.clear_store()

    def child_pids(self) -> list[int]:
        """Return the process ids of the children that run now."""
        return self._scenes.child_pids()

    def close(self) -> None:
        """End the child processes; a calibrate() in another thread raises WorkerError."""
        self._scenes.close()

    def __enter__(self) -> Calibrator:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.close()
