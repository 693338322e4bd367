"""Runs the Calibrator in two threads beside the executor: one detects, the other calibrates."""
from __future__ import annotations

import threading
import time
from collections.abc import Callable, Set
from dataclasses import replace
from typing import Any

from dashcalib_ros.arrays import Mask
from dashcalib_ros.calibrator import Calibrator
from dashcalib_ros.config import Config
from dashcalib_ros.detect import TurnId
from dashcalib_ros.judge.agreement import outdated, turns_of_another_camera
from dashcalib_ros.report import NamedCamera
from dashcalib_ros.ros.backlog import Backlog
from dashcalib_ros.ros.bank import Bank, Job
from dashcalib_ros.ros.detecting import detect
from dashcalib_ros.ros.news import NOTHING, Activity, Listener, Result, call, named, new_turns
from dashcalib_ros.ros.watch import Watch
from dashcalib_ros.status import Status

# s between two checks whether enough turns are built: scenes are finished without a push
LOOK_S = 0.25
LONGEST_BACK_OFF_S = 60.0


class Learner:
    """Learns in the background. All methods may be called from any thread; none of them waits.

    goal: calibrations start by themselves when so many turns are built, and again when others are
    among the best; None: only by request.
    """

    def __init__(self, config: Config, queue_size: int, listener: Listener,
                 mask: Mask | None = None) -> None:
        """mask: (h, w), False where the images are not to be used."""
        self.goal: int | None = config.turns.wanted
        self._config = config
        self._mask = mask
        self._tell = listener
        self._backlog: Backlog[Job] = Backlog(queue_size)
        # the Learner's own lock: guards _bank, _activity, _requested and what follows them
        self._changed = threading.Condition()
        self._bank = Bank(0, self._calibrator(use_stored=True))
        self._activity = Activity()
        self._watch = Watch(None)
        self._checked: NamedCamera | None = None
        self._requested = False
        self._failures = 0
        self._not_before = 0.0
        self._closed = False
        self._closing: list[threading.Thread] = []
        self._threads = [threading.Thread(target=self._detect, name='detect', daemon=True),
                         threading.Thread(target=self._calibrate, name='calibrate', daemon=True)]
        for thread in self._threads:
            thread.start()

    @property
    def dropped(self) -> int:
        """Return how many images were dropped because detection did not keep up."""
        return self._backlog.dropped

    @property
    def bank(self) -> int:
        """Return the number of the bank; results of an older one are out of date."""
        return self._bank.number

    def offer(self, index: int, stamp_ns: int, message: Any, size: tuple[int, int],
              frame_id: str = '') -> None:
        """Take an image message; size and frame_id are what its header says."""
        self._backlog.put(Job(self._bank, index, stamp_ns, message, size, frame_id))

    def activity(self) -> Activity:
        """Return what the learner does now."""
        return self._activity

    def request(self) -> str:
        """Calibrate now, with the present turns; return why not, '' if it is started."""
        with self._changed:
            activity = self._activity
            if activity.calibrating:
                return 'a calibration is running already'
            if not activity.status.turns:
                return 'no turn was found so far: drive some'
            self._requested = True
            self._changed.notify_all()
        return ''

    def want(self, turns: int) -> None:
        """Use so many turns from the next calibration on."""
        with self._changed:
            self._config = self._config.replace({'turns.wanted': turns})
            self._changed.notify_all()

    def compare(self, watched: NamedCamera | None, checked: NamedCamera | None = None) -> None:
        """Compare turns with cameras from now on; both may be called again with the same ones.

        watched: each new turn is compared with it, to find changes. checked: each calibration is
        compared with it; the present turns at once.
        """
        with self._changed:
            if watched is not self._watch.camera:
                self._watch = Watch(watched)
            if checked is not self._checked:
                self._checked = checked
                self._bank.tried = frozenset()

    def restart(self, keep_stored: bool = False) -> None:
        """Forget all turns and begin with an empty bank; a running calibration is cancelled.

        turns.store is emptied, too. keep_stored: turns.store stays and its turns are used, as the
        images are of another camera now.
        """
        with self._changed:
            if self._closed:
                return
            old = self._bank
            self._bank = Bank(old.number + 1, self._calibrator(use_stored=keep_stored))
            self._backlog.clear()
            self._requested = False
            self._failures, self._not_before = 0, 0.0
            self._activity = replace(self._activity, status=NOTHING)
            # ending a child takes a moment
            self._aside(old.calibrator.close if keep_stored else lambda: _clear(old.calibrator))
            self._changed.notify_all()

    def extend(self) -> bool:
        """Use one turn of this drive more with this bank; False where no more are kept."""
        with self._changed:
            turns = self._config.turns
            if turns.wanted + self._bank.more >= turns.capacity:
                return False
            self._bank.more += 1
            return True

    def forget_stored(self, but: Set[TurnId]) -> None:
        """Drop the turns of earlier drives but these: the camera has changed since."""
        with self._changed:
            calibrator = self._bank.calibrator
            self._aside(lambda: calibrator.forget_stored(but))

    def close(self) -> None:
        """End both threads and every child process."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._backlog.close()
        self._bank.calibrator.close()
        for thread in (*self._closing, *self._threads):
            thread.join(timeout=10)

    def _calibrator(self, use_stored: bool) -> Calibrator:
        return Calibrator(self._config, mask=self._mask, live=True, use_stored=use_stored,
                          warn=lambda text: self._trouble('store', text),
                          on_trouble=lambda text: self._trouble('workers', text))

    def _aside(self, task: Callable[[], None]) -> None:
        """Run a slow task in a thread of its own, for which close() waits."""
        self._closing = [thread for thread in self._closing if thread.is_alive()]
        self._closing.append(threading.Thread(target=task, daemon=True))
        self._closing[-1].start()

    def _detect(self) -> None:
        while (job := self._backlog.get()) is not None:
            status = detect(job, self._tell)
            if status is not None and self._note(job.bank, status):
                call(self._tell.status, status)

    def _note(self, bank: Bank, status: Status) -> bool:
        with self._changed:
            if bank is not self._bank:
                return False
            self._activity = replace(self._activity, status=status)
            fresh = new_turns(bank.told, status)
            bank.told |= set(status.ready)
            self._changed.notify_all()
        for turn in fresh:
            call(self._tell.turn, turn)
        return True

    def _calibrate(self) -> None:
        while (bank := self._wait_until_due()) is not None:
            call(self._tell.started, self._activity.status)
            given = self._checked
            try:
                calibration = bank.calibrator.calibrate(self._progress, final=False)
                check = None if given is None else bank.calibrator.check(
                    given.camera, calibration, self._progress)
                of_another = turns_of_another_camera(calibration.misfits, self._config.verdict)
                bank.calibrator.reject(
                    outdated(of_another | calibration.used_turns, of_another))
            except Exception as error:
                self._failed(bank, error)
                continue
            with self._changed:
                if given is self._checked:
                    bank.tried = frozenset(calibration.misfits)
                self._failures = 0
                self._activity = replace(self._activity, calibrating=False, stage='')
            complete = calibration.turns_used >= self._config.turns.wanted
            call(self._tell.result, Result(calibration, complete, bank.number, given, check))

    def _wait_until_due(self) -> Bank | None:
        """Return the bank to calibrate, None when closed."""
        while not self._closed:
            bank = self._bank
            try:
                # here, as it may wait for an image that is being searched for points
                bank.calibrator.want(self._config.turns.wanted, bank.more)
                status = bank.calibrator.status()
                self._note(bank, status)
                self._read(bank, status)
            except Exception as error:
                self._trouble('failed', f'the turns could not be counted: {named(error)}')
            with self._changed:
                ready = self._activity.status.ready
                news = (self.goal is not None and len(ready) >= self.goal
                        and not bank.tried.issuperset(ready))
                if (bank is self._bank and (self._requested or news)
                        and time.monotonic() >= self._not_before):
                    self._requested = False
                    self._activity = replace(self._activity, calibrating=True)
                    return bank
                if not self._closed:
                    self._changed.wait(LOOK_S)
        return None

    def _read(self, bank: Bank, status: Status) -> None:
        """Compare turns that are new with the camera in use."""
        try:
            found = self._watch.read(bank, status)
            lens = None if found is None else found.monitor.lens
            if lens is not None and lens.confirmed and lens.since.of_this_drive:
                # those of earlier drives are of the camera before the change
                bank.calibrator.forget_stored()
        except Exception as error:
            with self._changed:
                cancelled = bank is not self._bank or self._closed
            if not cancelled:
                self._trouble('failed_watches', f'new turns could not be compared with the '
                                                f'calibration in use ({named(error)}); the next '
                                                f'turn tries again')
            return
        if found is not None:
            call(self._tell.watched, found)

    def _progress(self, stage: str, share: float) -> None:
        with self._changed:
            self._activity = replace(self._activity, stage=stage, share=share)

    def _failed(self, bank: Bank, error: Exception) -> None:
        with self._changed:
            self._activity = replace(self._activity, calibrating=False, stage='')
            if bank is not self._bank or self._closed:
                return  # cancelled
            self._failures += 1
            delay = min(2.0 ** self._failures, LONGEST_BACK_OFF_S)
            self._not_before = time.monotonic() + delay
            # the same turns are tried again
            self._requested = True
        self._trouble('failed_calibrations', f'a calibration failed ({named(error)}); the '
                                             f'turns are kept, next try in {delay:.0f} s')

    def _trouble(self, kind: str, text: str) -> None:
        call(self._tell.trouble, kind, text)


def _clear(calibrator: Calibrator) -> None:
    calibrator.close()
    calibrator.clear_store()
