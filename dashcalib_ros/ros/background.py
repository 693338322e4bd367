# SPDX-License-Identifier: Apache-2.0
"""The background thread: it owns the calibrator, and does what comes into its inbox."""
from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Set
from dataclasses import dataclass, field, replace
from functools import reduce
from typing import Any

from dashcalib_ros import judge
from dashcalib_ros.arrays import GreyImage, Mask
from dashcalib_ros.config import Config
from dashcalib_ros.detect import TurnId
from dashcalib_ros.detect.detection import Detection
from dashcalib_ros.errors import DashcalibError, InputError, coded, counted, one_line
from dashcalib_ros.input import Frame
from dashcalib_ros.input.decode import BitDepth, decode
from dashcalib_ros.input.motion import SensorBuffer
from dashcalib_ros.judge import Check, Monitor, Reading, moved_text
from dashcalib_ros.judge.agreement import CONTRADICTS, outdated, turns_of_another_camera
from dashcalib_ros.pipeline import Calibrator
from dashcalib_ros.report import Calibration, NamedCamera
from dashcalib_ros.report.turns import BACK, LEFT, RIGHT
from dashcalib_ros.selection import Status
from dashcalib_ros.workers.memory import mapped_copy

# s between two checks whether enough turns are built: scenes are finished without a push
LOOK_S = 0.25
LONGEST_BACK_OFF_S = 60.0
# pairs of images of straight driving, each 0.3 s: when they are asked whether the camera was moved
# on the car, and how many of them
PAIRS_BETWEEN, PAIRS = 30, 120
# kinds of turns, by where direction() says that they go
WAYS = {RIGHT: 'right turn', LEFT: 'left turn', BACK: 'S-bend'}
NO_STATUS = Status(0, 0, 0, 0.0, 0.0, False)
Action = Callable[[], None]


@dataclass(frozen=True)
class Goal:
    """What the background thread works for.

    config: turns.wanted counts, from the next calibration on. turns: calibrations start by
    themselves when so many are built, and again when others are among the best; None: only by
    request. camera: one in use that each new turn is compared with, to find changes. check: one
    that each calibration is compared with, at once where it is new. Cameras are distinguished as
    objects: news about one say which.
    """

    config: Config
    turns: int | None = None
    camera: NamedCamera | None = None
    check: NamedCamera | None = None


@dataclass(frozen=True)
class Activity:
    """What the background thread does now. stage: of the calibration that runs."""

    status: Status = NO_STATUS
    calibrating: bool = False
    stage: str = ''


@dataclass(frozen=True)
class Measured:
    """An image was searched for turns. header: of its message."""

    header: Any
    status: Status


@dataclass(frozen=True)
class Result:
    """A calibration; complete: it had all the turns wanted; bank: the number of their bank.

    given, check: a camera that was to be checked, and what the calibration says about it.
    """

    calibration: Calibration
    complete: bool
    bank: int
    given: NamedCamera | None = None
    check: Check | None = None


@dataclass(frozen=True)
class Watched:
    """What the turns so far say about a camera in use."""

    camera: NamedCamera
    monitor: Monitor


@dataclass(frozen=True)
class Moved:
    """A camera in use was moved on the car, in words: straight stretches show it."""

    camera: NamedCamera
    text: str


@dataclass(frozen=True)
class Trouble:
    """A problem: its kind, for counting, and one line for the log."""

    kind: str
    text: str


# a text is for the log
News = Measured | str | Trouble | Result | Watched | Moved
# takes an image with its message's header, and what was found so far; it must not wait
ShowImage = Callable[[Any, GreyImage, Detection], None]


class Inbox:
    """What the background thread is to do next: commands first, then images, each in order.

    put() and put_image() never wait: when too many images wait, the oldest is dropped. dropped:
    how many were, because detection does not keep up.
    """

    def __init__(self, capacity: int) -> None:
        """capacity: how many images may wait."""
        self.dropped = 0
        self._commands: deque[Action] = deque()
        self._images: deque[Action] = deque(maxlen=capacity)
        # guards all of these
        self._filled = threading.Condition()

    def put(self, command: Action, instead_of_images: bool = False) -> None:
        """Add a command; instead_of_images: those that wait now are forgotten."""
        with self._filled:
            if instead_of_images:
                self._images.clear()
            self._commands.append(command)
            self._filled.notify()

    def put_image(self, action: Action) -> None:
        """Add what is to be done with an image."""
        with self._filled:
            self.dropped += len(self._images) == self._images.maxlen
            self._images.append(action)
            self._filled.notify()

    def get(self, wait_s: float) -> Action | None:
        """Take out what is next; wait for it so long at most, then return None."""
        with self._filled:
            if not (self._commands or self._images):
                self._filled.wait(wait_s)
            waiting = self._commands or self._images
            return waiting.popleft() if waiting else None


@dataclass(eq=False)
class _Bank:
    """A Calibrator and what belongs to its turns only.

    tried: the turns of the last calibration. logged: those that are in the log. requested: a
    calibration is to begin with the present turns. failures: of calibrations in a row.
    not_before: when the next one may begin, in s of time.monotonic(). read: the turns that were
    compared with the camera in use; readings: what they say. earlier: what those of the
    banks before said about it. pairs: of straight driving that were asked whether it was moved;
    moved: whether they said so.
    """

    number: int
    calibrator: Calibrator
    depth: BitDepth = field(default_factory=BitDepth)
    tried: frozenset[TurnId] = frozenset()
    logged: frozenset[TurnId] = frozenset()
    requested: bool = False
    failures: int = 0
    not_before: float = 0.0
    read: frozenset[TurnId] = frozenset()
    readings: dict[TurnId, Reading] = field(default_factory=dict)
    earlier: Monitor | None = None
    pairs: int = 0
    moved: bool = False


class Learner:
    """Learns in the background. All methods are for the node's thread; none of them waits.

    bank: the number of the present bank of turns; results of an older one are out of date.
    activity: what the background thread does now. inbox: what it is to do. sensors: what the car's
    own sensors say; it may be added to.
    """

    def __init__(self, goal: Goal, queue_size: int, hear: Callable[[News], None],
                 show: ShowImage, mask: Mask | None = None) -> None:
        """hear: called with all news, in any thread; it must neither wait nor raise.

        show: called with each image in the background thread. mask: (h, w), False where the images
        are not to be used.
        """
        self.bank = 0
        self._goal = goal
        # turns of this drive that are used beyond those wanted
        self._more = 0
        self._hear = hear
        self._show = show
        self._mask = mask
        self.inbox = Inbox(queue_size)
        self.sensors = SensorBuffer()
        self.activity = Activity()
        self._closed = False
        # from here on of the background thread only
        self._now = self._bank(0, use_stored=True)
        self._watching: NamedCamera | None = None
        self._monitor: Monitor | None = None
        self._tried_with: NamedCamera | None = None
        self._thread = threading.Thread(target=self._run, name='learn', daemon=True)
        self._thread.start()

    def watch(self, goal: Goal) -> None:
        """Work for another goal from now on."""
        self._goal = goal

    def offer(self, index: int, stamp_ns: int, message: Any, size: tuple[int, int],
              frame_id: str = '') -> None:
        """Take an image message; size and frame_id are what its header says."""
        self.inbox.put_image(lambda: self._push(index, stamp_ns, message, size, frame_id))

    def request(self) -> str:
        """Calibrate now, with the present turns; return why not, '' if it is started."""
        if self.activity.calibrating:
            return 'a calibration is already running'
        if not self.activity.status.turns:
            return 'no turn has been found yet: drive some turns'
        self.inbox.put(self._request)
        return ''

    def extend(self) -> bool:
        """Use one turn of this drive more with this bank; False where no more are kept."""
        turns = self._goal.config.turns
        if turns.wanted + self._more >= turns.capacity:
            return False
        self._more += 1
        return True

    def restart(self, keep_stored: bool = False) -> None:
        """Forget all turns and begin with an empty bank; a running calibration is cancelled.

        turns.store is emptied, too. keep_stored: turns.store stays and its turns are used, as the
        images are of another camera now.
        """
        new = self._bank(self.bank + 1, use_stored=keep_stored)
        self.bank, self._more = new.number, 0
        self.inbox.put(lambda: self._begin(new, keep_stored), instead_of_images=True)

    def forget_stored(self, but: Set[TurnId]) -> None:
        """Drop the turns of earlier drives but these: the camera has changed since."""
        self.inbox.put(lambda: self._now.calibrator.scenes.forget_stored(but))

    def close(self) -> None:
        """End the thread and every child process."""
        self._closed = True
        self.inbox.put(lambda: None)
        self._now.calibrator.close()
        self._thread.join(timeout=10)

    # in the background thread ------------------------------------------------------------------

    def _run(self) -> None:
        while not self._closed:
            self._serve(LOOK_S)
            bank = self._now
            self._look(bank)
            if self._due(bank) and not self._closed:
                self._calibrate(bank)
        # close() may have seen the bank before
        self._now.calibrator.close()

    def _serve(self, wait_s: float = 0.0) -> bool:
        """Do what is next in the inbox, also while the calibrator waits for a child."""
        action = self.inbox.get(wait_s)
        if action is None or self._closed:
            return False
        try:
            action()
        except Exception as error:
            self._hear(Trouble('failed', f'an image or a request failed: {_error_text(error)}'))
        return True

    def _bank(self, number: int, use_stored: bool) -> _Bank:
        calibrator = Calibrator(
            self._goal.config, mask=self._mask, live=True, use_stored=use_stored,
            warn=lambda notice: self._hear(Trouble('store', str(notice))),
            on_trouble=lambda text: self._hear(Trouble('workers', text)), on_wait=self._serve)
        return _Bank(number, calibrator)

    def _begin(self, new: _Bank, keep_stored: bool) -> None:
        old, self._now = self._now, new
        self.activity = replace(self.activity, status=NO_STATUS)
        old.calibrator.close()
        if not keep_stored:
            old.calibrator.scenes.clear_store()

    def _request(self) -> None:
        self._now.requested = True

    def _push(self, index: int, stamp_ns: int, message: Any, size: tuple[int, int],
              frame_id: str) -> None:
        bank = self._now
        try:
            image = mapped_copy(decode_checked(message, size, bank.depth))
            status = bank.calibrator.push(Frame(index, stamp_ns, image, frame_id))
        except InputError as error:
            self._hear(Trouble('undecodable', coded(error)))
            return
        self._show(message.header, image, bank.calibrator.detection)
        self._note(bank, status)
        self._hear(Measured(message.header, status))

    def _look(self, bank: _Bank) -> None:
        try:
            # a camera in use is compared with turns: a stabiliser can hide no turn
            bank.calibrator.scenes.want(self._goal.config.turns.wanted, self._more,
                                        self._goal.camera is None and self._goal.check is None)
            status = bank.calibrator.status()
        except Exception as error:
            self._hear(Trouble('failed', f'the turns could not be counted: {_error_text(error)}'))
            return
        self._note(bank, status)
        if self._watching is not self._goal.camera:
            self._watching, self._monitor, bank.read = self._goal.camera, None, frozenset()
            bank.readings, bank.moved = {}, False
        if self._watching is None:
            return
        try:
            self._watch(bank, self._watching, frozenset(status.reconstructed))
        except Exception as error:
            if bank is self._now and not self._closed:
                self._hear(Trouble(
                    'failed_watches', f'the drive could not be compared with the calibration in '
                                      f'use ({_error_text(error)}); this is repeated at the next '
                                      f'turn'))

    def _watch(self, bank: _Bank, camera: NamedCamera, turns: frozenset[TurnId]) -> None:
        if not turns <= bank.read:
            self._read(bank, camera, turns)
        pairs = bank.calibrator.detection.straight_pairs
        # a long drive thins them out
        if not bank.moved and not 0 <= pairs - bank.pairs < PAIRS_BETWEEN:
            bank.pairs = pairs
            detection = bank.calibrator.detection
            straights = detection.straights(PAIRS)
            found = bank.calibrator.workers.run(judge.moved, straights,
                                                detection.resized(camera.camera))
            if found is not None:
                bank.moved = True
                ago_s = straights.stamps_s[-1] - found[0]
                self._hear(Moved(camera, moved_text(f'than {ago_s:.0f} s ago', found[1])))

    def _read(self, bank: _Bank, camera: NamedCamera, turns: frozenset[TurnId]) -> None:
        """Compare turns that are new with the camera in use.

        A bank begins empty after each complete calibration; what the turns of the banks before it
        said is kept, so that a change that was found is not forgotten.
        """
        if not bank.read:
            bank.earlier = self._monitor
        # the same turns alone are not tried again
        bank.read |= turns
        core = bank.calibrator
        lens, scenes, config = (core.detection.resized(camera.camera),
                                core.scenes.reconstructed(), core.scenes.config)
        if new := [scene for scene in scenes if scene.turn not in bank.readings]:
            bank.readings |= {reading.turn: reading for reading in core.workers.run(
                judge.readings_of, new, lens, config)}
        # a stored turn that was driven again counts once
        there = {scene.turn for scene in scenes}
        found = judge.watch((reading for turn, reading in bank.readings.items()
                             if turn.of_this_drive or turn in there), lens, camera.sigma,
                            config.monitor, core.detection.scale.px)
        if bank.earlier is not None:
            found = reduce(Monitor.after, found.readings, bank.earlier)
        if found.lens and found.lens.confirmed and found.lens.since.of_this_drive:
            # those of earlier drives are of the camera before the change
            bank.calibrator.scenes.forget_stored()
        self._monitor = found
        self._hear(Watched(camera, found))

    def _note(self, bank: _Bank, status: Status) -> None:
        self.activity = replace(self.activity, status=status)
        for line in new_turns(bank.logged, status, self._goal.config.turns.wanted,
                              self._goal.camera is not None):
            self._hear(line)
        bank.logged |= set(status.ready)

    def _due(self, bank: _Bank) -> bool:
        goal = self._goal
        if goal.check is not self._tried_with:
            self._tried_with, bank.tried = goal.check, frozenset()
        status = self.activity.status
        count = len(status.ready) + len(status.stretches)
        # a calibration takes its time: one new turn is worth it, one new stretch is not
        news = goal.turns is not None and count >= goal.turns and (
            not bank.tried.issuperset(status.ready)
            or len(set(status.stretches) - bank.tried) >= goal.turns)
        return (bank.number == self.bank and (bank.requested or news)
                and time.monotonic() >= bank.not_before)

    def _calibrate(self, bank: _Bank) -> None:
        bank.requested, given = False, self._goal.check
        self.activity = replace(self.activity, calibrating=True)
        self._hear(beginning(self.activity.status))
        try:
            stream = self.sensors.stream()
            found = bank.calibrator.detection
            if found.frames and (stream.warnings or not stream.empty):
                # both have the same clock, whichever it is
                bank.calibrator.sense(replace(stream.shifted(-found.start_s), absolute=False))
            calibration = bank.calibrator.calibrate(self._progress, final=False)
            check = None
            if given is not None:
                self._progress('the turns with the given camera', 0.0)
                check = bank.calibrator.workers.run(
                    judge.check, given.camera, calibration.image_size, bank.calibrator.solution,
                    calibration.verdict, calibration.config, found.lines())
            of_another = turns_of_another_camera(calibration.misfits)
            bank.calibrator.scenes.exclude(dict.fromkeys(
                outdated(of_another | calibration.used_turns, of_another), CONTRADICTS))
        except Exception as error:
            self._failed(bank, error)
            return
        finally:
            self.activity = replace(self.activity, calibrating=False, stage='')
        bank.tried, bank.failures = frozenset(calibration.misfits), 0
        complete = calibration.turns_used >= self._goal.config.turns.wanted
        self._hear(Result(calibration, complete, bank.number, given, check))

    def _progress(self, stage: str, share: float) -> None:
        self.activity = replace(self.activity, stage=stage)

    def _failed(self, bank: _Bank, error: Exception) -> None:
        if bank is not self._now or self._closed:
            return  # cancelled
        bank.failures += 1
        delay = min(2.0 ** bank.failures, LONGEST_BACK_OFF_S)
        bank.not_before = time.monotonic() + delay
        # the same turns are tried again
        bank.requested = True
        self._hear(Trouble(
            'failed_calibrations', f'a calibration failed ({_error_text(error)}); the turns are '
                                   f'kept, and the next attempt is in {delay:.0f} s'))


def decode_checked(message: Any, size: tuple[int, int], depth: BitDepth | None = None
                   ) -> GreyImage:
    """Decode a message whose header says this size; raises InputError if it is not so."""
    image = decode(message, depth)
    if image.shape[::-1] != size:
        raise InputError('E-IMAGE-SIZE-NOT-AS-HEADER',
                         f'an image is {image.shape[1]}x{image.shape[0]} but its header says '
                         f'{size[0]}x{size[1]}: fix the camera driver')
    return image


def new_turns(logged: Set[TurnId], now: Status, wanted: int, checking: bool) -> list[str]:
    """Return 'turn 2 of 5: 89° to the left, 179° in all' for each new turn that is ready now.

    The total is that of the turns so far; a turn that replaces another has the last number.
    checking: the turns check a calibration in use.
    """
    fresh = [place for place, turn in enumerate(now.ready) if turn not in logged]
    total = sum(now.yaws_deg) - sum(now.yaws_deg[place] for place in fresh)
    purpose = ' for the next check of the calibration' if checking else ''
    lines = []
    for count, place in enumerate(fresh, len(now.ready) - len(fresh) + 1):
        yaw = now.yaws_deg[place]
        total += yaw
        number = f'turn {count} of {wanted}' if count <= wanted else f'turn {count}'
        source = '' if now.ready[place].of_this_drive else ' (of an earlier drive)'
        way = f' {now.ways[place]}' if now.ways else ''
        lines.append(f'{number}{purpose}{source}: {yaw:.0f}°{way}, {total:.0f}° in all')
    return lines


def seen(status: Status, needed: int, sigma: float | None = None) -> str:
    """Return what turns there are, and how many are missing, for who drives.

    needed: turns with which a calibration begins. sigma: of fx, of it, by those so far.
    """
    ways = Counter(status.ways)
    kinds = [counted(ways[way], name) for way, name in WAYS.items() if ways[way]]
    kinds = [f'{", ".join(kinds)}, {status.yaw_deg:.0f}° in all' if kinds else 'no turn yet']
    kinds += [counted(count, name) for count, name in (
        (status.bends, 'bend'), (len(status.stretches) - status.bends, 'straight piece'))
        if count]
    text = ', '.join(kinds) + (f'; fx ± {100 * sigma:.2g} % so far' if sigma else '')
    missing = needed - status.built
    return f'{text}; {counted(missing, "more turn")} needed' if missing > 0 else text


def beginning(status: Status) -> str:
    """Return the line about a calibration that begins."""
    if not status.built and not status.stretches:
        return (f'calibrating, as soon as {counted(status.turns, "turn")} found so far can be '
                f'used…')
    more = len(status.stretches)
    return (f'calibrating with {counted(status.built, "turn")}, {status.yaw_deg:.0f}° of yaw'
            + (f', and {counted(more, "other piece")} of the drive' if more else '') + '…')


def _error_text(error: Exception) -> str:
    if isinstance(error, DashcalibError):
        return coded(error, 500)
    return f'{type(error).__name__}: {one_line(error, 500)}'
