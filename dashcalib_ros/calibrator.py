"""The complete calibration: detect turns, reconstruct each, solve for one camera, judge it.

The stages are in stages.py; the Calibrator decides only what runs when.
"""
from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from types import TracebackType

from dashcalib_ros import stages
from dashcalib_ros.arrays import Mask
from dashcalib_ros.camera import searched
from dashcalib_ros.config import Config
from dashcalib_ros.frames import Frame
from dashcalib_ros.judgement import Calibration
from dashcalib_ros.judgement.agreement import evidence_of
from dashcalib_ros.judgement.conclude import Evidence, evidence_of_detection
from dashcalib_ros.selection import Progress, SceneSelection
from dashcalib_ros.solve.solution import Solution
from dashcalib_ros.turns import Turn, TurnId
from dashcalib_ros.turns.detection import Detection


@dataclass(frozen=True)
class Status:
    """The calibrator's state after a frame.

    frames: pushed so far. turns: in the bank and stored. built: how many scenes a calibration
    would use now; ready: their turns; yaw_deg: the sum of their yaw. stored: how many turns are of
    earlier drives. magnitude: the newest filtered turning magnitude, of the image width.
    """

    frames: int
    turns: int
    built: int
    yaw_deg: float
    magnitude: float
    standing: bool
    ready: tuple[TurnId, ...] = ()
    stored: int = 0


class Calibrator:
    """Learns a camera from the turns of a drive.

    push() the frames as they come; calibrate() when enough turns have gathered, or at the end.
    push() and calibrate() may be called from two threads: push() never waits for a calibration.
    close() ends the child processes; a Calibrator is also a context manager.
    """

    def __init__(self, config: Config | None = None, mask: Mask | None = None,
                 verbose: bool = False, live: bool = False, use_stored: bool = True,
                 warn: Callable[[str], None] = lambda text: None, inline: bool = False,
                 on_trouble: Callable[[str], None] = lambda text: None) -> None:
        """mask: (h, w), False where the ego vehicle is.

        live: children run at low priority, and push() never waits for them; offline it does, so
        that few turns are in memory at a time. use_stored: False does not load the turns in
        turns.store, but adds to them. warn: called with one line for each problem with
        turns.store, from any thread; the result's warnings have them, too. inline: everything runs
        in this process, with equal results; numpy must have one thread, else WorkerError says how;
        close() then does not end what runs. on_trouble: called with one line for each child that
        died or hangs, and for each turn that is tried again after that, from any thread.
        """
        self._config = config or Config()
        searched(self._config.model)  # raises ConfigError for one that there is not
        # guards what push() and calibrate() share: the detection and the selection of turns
        self._lock = threading.Lock()
        self._detection = Detection(self._config, mask)
        self._scenes = SceneSelection(self._config, self._detection, self._lock, live, verbose,
                                      use_stored, warn, inline, on_trouble)
        self._detect_s = 0.0
        self._started = time.monotonic()

    def push(self, frame: Frame) -> Status:
        """Take the next frame; raises InputError when its size differs from the first one's."""
        started = time.monotonic()
        with self._lock:
            new = self._detection.push(frame)
            if self._detection.frames == 1:
                self._scenes.load(frame.frame_id)
            if new:
                self._scenes.submit()
        self._detect_s += time.monotonic() - started
        self._scenes.make_room()
        return self.status()

    def calibrate(self, progress: Progress | None = None, final: bool = True) -> Calibration:
        """Adjust the best turns' scenes together and judge the result.

        final: the drive is over, and its last turn may end here; no push() may follow.
        progress: called with the stage's name and the share done.
        """
        tell = progress or (lambda stage, done: None)
        with self._lock:
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
        if scenes:
            solution = self._scenes.run(stages.solve, scenes, self._config, progress=tell)
            self._scenes.reject({scene.turn for scene in scenes}
                                - evidence_of(solution, self._config.verdict))
        return stages.judge(solution, self._evidence(started), self._config)

    def _evidence(self, started: float) -> Evidence:
        now = time.monotonic()
        timing = {'detect': self._detect_s, 'calibrate': now - started,
                  'total': now - self._started}
        with self._lock:
            return evidence_of_detection(
                self._detection, self._scenes.built(), timing, tuple(self._scenes.warnings),
                self._scenes.stored_before())

    def turns(self) -> tuple[Turn, ...]:
        """Return the bank's turns, the most prominent first."""
        with self._lock:
            return self._detection.turns()

    def status(self) -> Status:
        """Return the present state."""
        with self._lock:
            chosen, stored = self._scenes.chosen(), len(self._scenes.stored())
            found = self._detection
            return Status(found.frames, len(found.turns()) + stored, len(chosen),
                          sum(scene.yaw_deg for scene in chosen), found.magnitude,
                          found.standing, tuple(scene.turn for scene in chosen), stored)

    def reject(self, turns: Iterable[TurnId]) -> None:
        """Take turns out that are not of the present camera."""
        self._scenes.reject(turns)

    def forget_stored(self) -> None:
        """Drop the turns of earlier drives, also on disk: for a camera that has changed since."""
        self._scenes.forget_stored()

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


def calibrate(path: str | os.PathLike[str], fps: float | None = None,
              config: Config | None = None, topic: str | None = None) -> Calibration:
    """Calibrate a recorded drive.

    path, topic, fps: as for open_frames(). Raises InputError for what cannot be read; a drive that
    teaches too little gives a calibration that is weak or refused.
    """
    # the node has no use for the readers of files
    from dashcalib_ros.inputs import open_frames
    with Calibrator(config) as calibrator:
        for frame in open_frames(path, topic, fps):
            calibrator.push(frame)
        return calibrator.calibrate()
