"""The complete calibration: detect turns, reconstruct each, solve for one camera, judge it."""
from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import TracebackType

from dashcalib_ros.arrays import Mask
from dashcalib_ros.camera import searched
from dashcalib_ros.config import Config
from dashcalib_ros.detect import Turn, TurnId
from dashcalib_ros.detect.detection import Detection
from dashcalib_ros.input import Frame
from dashcalib_ros.input.motion import SensorStream
from dashcalib_ros.judge.agreement import earlier_of_another_camera, evidence_of
from dashcalib_ros.judge.conclude import (
    CONTRADICTS,
    STOOD,
    Evidence,
    conclude,
    evidence_of_detection,
)
from dashcalib_ros.judge.witnesses import Asked, ask_sensors
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.report import Calibration
from dashcalib_ros.selection import Progress, SceneSelection
from dashcalib_ros.solve import solve
from dashcalib_ros.solve.solution import Solution


@dataclass(frozen=True)
class Status:
    """The calibrator's state after a frame.

    frames: pushed so far. turns: in the bank and stored. built: how many scenes a calibration
    would use now; ready: their turns; yaw_deg: the sum of their yaw. stored: how many turns are of
    earlier drives. magnitude: the newest filtered turning magnitude, of the image width.
    yaws_deg: of the turns in ready, in their order. reconstructed: the turns that watch() has
    scenes of, chosen or not. two_cameras: what the newest images show, if they are of two.
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


class Calibrator:
    """Learns a camera from the turns of a drive.

    push() the frames as they come; calibrate() when enough turns have gathered, or at the end.
    expect() so many frames, where that is known. close() ends the child processes; a Calibrator is
    also a context manager. questions.py asks its turns about other cameras. All methods are for
    one thread, but close(), which is for any.

    detection: what was found in the frames so far: turns, tracked points, the ego vehicle. scenes:
    the turns that were reconstructed; which are used, taken out, stored. solution: what the last
    calibrate() judged, in the resized pictures' pixels; None before, and where there is none.
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
        turns.store; the result's warnings have them, too. inline: everything runs in this process,
        with equal results; numpy must have one thread, else WorkerError says how; close() then
        does not end what runs. on_trouble: called with one line for each child that died or hangs,
        and for each turn that is tried again after that, from any thread. on_wait: called again
        and again while a worker is waited for; it may push() a frame, so that a live drive goes
        on, and returns whether it did something.
        """
        config = config or Config()
        searched(config.model)  # raises ConfigError for one that there is not
        self.detection = Detection(config, mask, beside=not live)
        self.scenes = SceneSelection(config, self.detection, live, verbose, use_stored, warn,
                                     inline, on_trouble, on_wait)
        self._live = live
        self.solution: Solution | None = None
        self._motion: SensorStream | None = None
        self._detect_s = 0.0
        self._started = time.monotonic()

    def push(self, frame: Frame) -> Status:
        """Take the next frame; raises InputError when its size differs from the first one's."""
        started = time.monotonic()
        new = self.detection.push(frame)
        if self.detection.frames == 1:
            self.scenes.load(frame.frame_id)
        if new:
            self.scenes.submit(more_to_come=True)
        self._detect_s += time.monotonic() - started
        self.scenes.make_room()
        return self.status()

    def expect(self, frames: int | None) -> None:
        """Tell how many frames the drive has, None where that is not known.

        The result does not depend on it: late in a drive, more of the turns are begun.
        """
        self.scenes.expected = frames

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
            self.detection.finish()
        self.scenes.submit()
        started = time.monotonic()
        calibration = self._solve_and_judge(tell, final, started)
        # a weak result is calculated again with more turns
        if calibration.verdict.level == 'weak' and self.scenes.widen():
            calibration = self._solve_and_judge(tell, final, started)
        return calibration

    def _solve_and_judge(self, tell: Progress, final: bool, started: float) -> Calibration:
        """Return the calibration from the turns that are selected now."""
        tell('reconstructing turns', 0.0)
        scenes, solution = self._moving(tell, final)
        config, asked = self.scenes.config, Asked()
        if scenes:
            if self._motion is not None:
                tell('evaluating the motion sensors', 0.0)
                asked = self.scenes.run(ask_sensors, solution, self._motion,
                                        self.detection.start_s, config)
                solution = asked.solution
            contradicted = earlier_of_another_camera(scenes, solution)
            self.scenes.leave_out(contradicted)
            self.scenes.reject(dict.fromkeys(
                {scene.turn for scene in scenes} - evidence_of(solution, config.verdict)
                - contradicted, CONTRADICTS))
        self.solution = solution
        # the solution itself is judged
        evidence = self._evidence(started, replace(asked, solution=None))
        if not self._live or solution is None:
            return conclude(solution, evidence, config)
        # it takes a second or two, and a live drive goes on meanwhile
        found: Calibration = self.scenes.run(conclude, solution, evidence, config)
        return found

    def _moving(self, tell: Progress, final: bool) -> tuple[list[Scene], Solution | None]:
        """Return the best turns, and their solution; of none do sensors say that the car stood."""
        while True:
            scenes, solution = self.scenes.wanted(tell, final, solve)
            start_s = self.detection.start_s
            stream = (self._motion or SensorStream()).since(start_s)
            stood = [scene.turn for scene in scenes if scene.turn.of_this_drive
                     and stream.stood(*(scene.tracks.stamps_ns[[0, -1]] / 1e9 - start_s))]
            if not stood:
                return scenes, solution
            self.scenes.reject(dict.fromkeys(stood, STOOD))

    def _evidence(self, started: float, asked: Asked) -> Evidence:
        now = time.monotonic()
        timing = {'detect': self._detect_s, 'calibrate': now - started,
                  'total': now - self._started}
        seen = evidence_of_detection(self.detection, self.scenes.built())
        return replace(
            seen, timing=timing, warnings=(*seen.warnings, *self.scenes.warnings),
            stored=self.scenes.stored_before(), left_out=self.scenes.left_out(),
            pictures=None if self._live else self.scenes.pictures(), motion=self._motion,
            asked=asked)

    def turns(self) -> tuple[Turn, ...]:
        """Return the bank's turns, the most prominent first."""
        return self.detection.turns()

    def status(self) -> Status:
        """Return the present state; scenes that are new are written to turns.store.

        Those of a drive of two cameras are not.
        """
        found = self.detection
        self.scenes.store_new()
        chosen, stored = self.scenes.chosen(), len(self.scenes.stored())
        return Status(found.frames, len(found.turns()) + stored, len(chosen),
                      sum(scene.yaw_deg for scene in chosen), found.magnitude,
                      found.standing, tuple(scene.turn for scene in chosen), stored,
                      tuple(scene.yaw_deg for scene in chosen),
                      tuple(self.scenes.all_scenes()),
                      str(found.other_camera) if found.mixed else '')

    def close(self) -> None:
        """End threads and child processes; a calibrate() elsewhere raises WorkerError."""
        self.detection.close()
        self.scenes.close()

    def __enter__(self) -> Calibrator:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.close()
