# SPDX-License-Identifier: Apache-2.0
"""The whole story: frames -> turns -> scenes -> one camera -> verdict."""
from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any

from dashcalib_ros.camera import searched
from dashcalib_ros.config import Config
from dashcalib_ros.detect.detection import Detection
from dashcalib_ros.errors import Notice, spared
from dashcalib_ros.input import Frame
from dashcalib_ros.input.decode import mask_of
from dashcalib_ros.input.motion import Samples, SensorStream, temperature_of
from dashcalib_ros.judge import agreement
from dashcalib_ros.judge.conclude import Evidence, conclude, evidence_of_detection
from dashcalib_ros.judge.witnesses import SensorComparison, compare_sensors
from dashcalib_ros.reconstruct.repeated import without_repeated
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.report import Calibration
from dashcalib_ros.selection import Plan, SceneSelection, Status
from dashcalib_ros.solve import solve
from dashcalib_ros.solve.solution import Solution
from dashcalib_ros.store.scene_file import StoredTurn
from dashcalib_ros.workers.memory import in_a_file
from dashcalib_ros.workers.pool import pool_of
from dashcalib_ros.workers.worker import Progress


class Calibrator(AbstractContextManager['Calibrator']):
    """Learns a camera from the turns of a drive.

    push() the frames as they come; calibrate() when enough turns have gathered, or at the end.
    close() ends the child processes; a Calibrator is also a context manager. All methods are for
    one thread, but close(), which is for any.

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
        turns.store, but adds to them. warn: gets one line for each problem with turns.store, as
        the result's warnings. inline: all runs in this process, with equal results; numpy must
        have one thread, else WorkerError says how. on_trouble: gets one line for each child that
        died or hangs, and each turn that is tried again, from any thread. on_wait: called again
        and again while a worker is waited for; it may push() a frame, so that a live drive goes
        on, and returns whether it did something. Raises ConfigError, InputError.
        """
        config, mask = Config.of(config), mask_of(mask)
        searched(config.model)
        self.solution: Solution | None = None
        self._live, self._workers = live, config.workers
        self._motion: SensorStream | None = None
        self._warmth: SensorStream | None = None
        self._lost: list[Notice] = []  # what the calibration under way has to do without
        self._stored: tuple[StoredTurn, ...] = ()  # and what it has from earlier drives
        self._detect_s, self._started = 0.0, time.monotonic()
        self.detection = Detection(config, mask, beside=not live, keep=None if live else in_a_file)
        self.workers = pool_of(config, live, verbose, inline, on_trouble, on_wait)
        self.scenes = SceneSelection(config, self.detection, self.workers, live, use_stored, warn)

    def push(self, frame: Frame) -> Status:
        """Take the next frame; raises InputError when its size differs from the first one's."""
        started = time.monotonic()
        new_turns = self.detection.push(frame)  # frames -> turns
        if self.detection.frames == 1:
            self.scenes.load(frame.frame_id)
        if new_turns:
            self.workers.start()
            self._carry_out(self.scenes.plan(more_to_come=True))  # in the background
        self._detect_s += time.monotonic() - started
        if self._live:
            self.detection.want_stretches(self.scenes.few)
            self._carry_out(self.scenes.stretch_plan())
        else:
            # one beside those that the workers have: the detection goes on, and none of them idles
            self.workers.wait(lambda: len(self.workers.unbuilt()) <= self._workers + 1)
        return self.status()

    def sense(self, motion: SensorStream | None, warmth: SensorStream | None = None) -> None:
        """Take what the car's sensors say about the drive so far; it replaces what came before.

        Stamps count from the first image. warmth: has the temperature, where motion has not.
        """
        self._motion, self._warmth = motion, warmth

    def calibrate(self, progress: Progress | None = None, final: bool = True) -> Calibration:
        """Adjust the best turns' scenes together and judge the result.

        final: the drive is over, and its last turn may end here; no push() may follow.
        progress: called with the stage's name and the share done.
        """
        progress, started = progress or (lambda stage, done: None), time.monotonic()
        if final:
            self.detection.finish()
        found = self._calibrate(progress, final, started)
        if found.verdict.level == 'weak' and self.scenes.widen():
            found = self._calibrate(progress, final, started)  # with more turns
        return found

    def status(self) -> Status:
        """Return the present state; scenes that are new are written to turns.store."""
        return self.scenes.status()

    def close(self) -> None:
        """End threads and child processes; a calibrate() elsewhere raises WorkerError."""
        self.detection.close()
        self.workers.close()

    def _carry_out(self, plan: Plan) -> None:
        if plan.keep is not None:
            self.workers.keep_only(plan.keep)
        for turn, valid in plan.build:
            self.workers.submit(turn, valid)
            self.detection.release(turn.center)
        for turn in plan.set_aside:
            self.detection.set_aside(turn)

    def reconstruct(self, progress: Progress, final: bool) -> list[Scene]:
        """Wait for the best turns' scenes and return them, the best first, as calibrate() does."""
        # all turns, also those that are not used: the report must not depend on the workers' speed
        everything = final or not self._live
        while True:
            self.workers.wait_for_turns(
                progress, lambda: not (everything or self.scenes.undecided()))
            self._carry_out(self.scenes.plan())
            self.scenes.store_new()
            if not (self.scenes.undecided() or (everything and self.workers.unbuilt())):
                self._stored = self.scenes.stored()
                return self.scenes.chosen()

    def _calibrate(self, progress: Progress, final: bool, started: float) -> Calibration:
        self._lost, config = [], self.scenes.config
        scenes, solution = self._solve(config, progress, final)  # scenes -> one camera
        sensors = SensorComparison(solution)
        if self._motion is not None:
            progress('evaluating the motion sensors', 0.0)
            sensors = spared('the comparison with the motion sensors', self._lost,
                             self.workers.run, compare_sensors, solution, self._motion,
                             self.detection.start_s, config) or sensors
            self.workers.check_open()
        self.solution = solution = sensors.solution
        # these do not count in the next calibration; files of another camera's turns stay
        self.scenes.exclude(agreement.turns_of_earlier_cameras(scenes, solution), keep_files=True)
        self.scenes.exclude(agreement.contradicting_turns(scenes, solution))
        what = solution, self.evidence(started, replace(sensors, solution=None)), config
        # one camera -> verdict: it takes a second or two, and a live drive goes on meanwhile
        return Calibration.of(conclude(*what) if not self._live or solution is None
                              else self.workers.run(conclude, *what))

    def _solve(self, config: Config, progress: Progress, final: bool
               ) -> tuple[list[Scene], Solution | None]:
        while scenes := self.reconstruct(progress, final):
            stood = spared('what the speed says about the turns', self._lost,
                           agreement.turns_that_stood, scenes, self._motion,
                           self.detection.start_s)
            if stood:
                self.scenes.exclude(stood)
                continue
            # the search for repeated pictures takes a second and hardly ever finds some
            search = self.workers.begin(without_repeated, scenes)
            solving = self.workers.begin(solve, scenes, config, self._temperature, reports=True)
            kept, repeated = self.workers.result(search)
            if repeated:
                self.workers.drop(solving)
                self.scenes.exclude_repeated(repeated)
                continue
            if any(len(one.tracks.frames) < len(other.tracks.frames)
                   for one, other in zip(kept, scenes, strict=True)):
                self.workers.drop(solving)
                solving = self.workers.begin(solve, kept, config, self._temperature, reports=True)
            return kept, self.workers.result(solving, progress)
        return [], None

    @property
    def _temperature(self) -> Samples | None:
        return spared('the temperature', self._lost, temperature_of, (self._warmth, self._motion),
                      self.detection.start_s)

    def evidence(self, started: float, sensors: SensorComparison) -> Evidence:
        """Return what a result needs beside the solution. started: s of time.monotonic()."""
        now = time.monotonic()
        seen = evidence_of_detection(self.detection, self.scenes.built().values())
        return replace(
            seen, timing={'detect': self._detect_s, 'calibrate': now - started,
                          'total': now - self._started},
            warnings=(*seen.warnings, *self.scenes.warnings, *self.workers.lost, *self._lost, *(
                self._warmth.since(seen.start_s).warnings if self._warmth else ())),
            stored=self._stored, left_out=self.scenes.left_out(), sensors=sensors,
            pictures=None if self._live else self.workers.pictures(), motion=self._motion,
            temperature=self._temperature)

    def __exit__(self, *_: object) -> None:
        self.close()
