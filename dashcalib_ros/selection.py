# SPDX-License-Identifier: Apache-2.0
"""Which turns are reconstructed, and which scenes a calibration uses."""
from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Set
from dataclasses import replace

from dashcalib_ros.arrays import Mask
from dashcalib_ros.config import Config
from dashcalib_ros.detect import Turn, TurnId
from dashcalib_ros.detect.detection import Detection
from dashcalib_ros.detect.turn import is_turn
from dashcalib_ros.errors import Notice, WorkerError
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.store.scene_file import Origin, StoredTurn
from dashcalib_ros.store.turn_store import TurnStore
from dashcalib_ros.workers.memory import in_a_file
from dashcalib_ros.workers.pool import ScenePool
from dashcalib_ros.workers.worker import Progress

# why a turn is not used, in words
NO_SCENE = ('its pictures gave no scene: too dark, blurred or empty to follow enough points, or '
            'the car hardly moved')
UNCONFIRMED = 'this drive has no turn that could agree with it'
# turns that wait for better ones; of KITTI 03 five are reconstructed then, not eight
WAITING = 3


class SceneSelection:
    """Decides which turns are reconstructed and which scenes count, stored ones too.

    config: turns.wanted is what want() was called with last. warnings: about turns.store, and
    about turns that ended the workers. stored_before: the turns of earlier drives that the last
    wanted() had to choose from. All methods are for the Calibrator's thread.
    """

    def __init__(self, config: Config, detection: Detection, workers: ScenePool,
                 live: bool = False, use_stored: bool = True,
                 warn: Callable[[Notice], None] = lambda notice: None) -> None:
        """live, use_stored, warn: as the Calibrator's."""
        self.config = config
        self.warnings: list[Notice] = []
        self.stored_before: tuple[StoredTurn, ...] = ()
        self._detection = detection
        self._workers = workers
        self._live = live
        self._use_stored = use_stored
        self._warn = warn
        # how many turns are used: more than wanted once these have left a result weak
        self._places = config.turns.wanted
        # turns of this drive that are used beyond that
        self._more = 0
        # whether other stretches are used at all, and even where there are enough turns
        self._stretches_wanted = not live
        self._stretches = config.turns.thorough
        # why turns do not count any more
        self._excluded: dict[TurnId, str] = {}
        # where the ego vehicle is not, by turn
        self._valid: dict[TurnId, Mask | None] = {}
        # the turns whose pictures are in files
        self._in_a_file: set[TurnId] = set()
        turns = config.turns
        self._store = TurnStore(turns.store, max(turns.capacity, turns.wanted), turns.half_width,
                                self._store_failed)
        # the turns whose scenes were written to it
        self._written: Set[TurnId] = frozenset()

    def load(self, frame_id: str) -> None:
        """Load the turns of earlier drives, at the first frame: they must fit its size and id."""
        assert self._detection.size is not None
        self._store.load(Origin(self._detection.size, self._detection.scale, frame_id),
                         self._use_stored)

    # which turns count ------------------------------------------------------------------------

    def want(self, turns: int, more: int = 0, stretches: bool = True) -> None:
        """Use this number of turns from the next calibration on, at most turns.capacity.

        more: turns of this drive are used beyond those. stretches: whether other stretches of the
        drive are, where turns are few; until it is called, those of a live drive are not.
        """
        self._more = more
        self._stretches_wanted = stretches
        if turns != self.config.turns.wanted:
            self.config = self.config.replace({'turns.wanted': turns})
            self._places = turns

    def widen(self) -> bool:
        """Use more turns, up to turns.at_most, and other stretches; False if there are none."""
        turns = self.config.turns
        before = self._places, self._stretches
        if len(self._ranked()) > self._places:
            self._places = max(turns.at_most, turns.wanted)
        few = len(self._detection.turns()) < before[0]
        self._stretches = self._stretches or (not few and bool(self._detection.stretches()))
        return before != (self._places, self._stretches)

    def exclude(self, reasons: Mapping[TurnId, str], keep_files: bool = False) -> None:
        """Let turns not count any more, each for a reason in words.

        keep_files: those of earlier drives stay in turns.store, for drives of their own camera.
        """
        if not reasons:
            return
        self._excluded.update(reasons)
        if keep_files:
            return
        for key in reasons:
            if self._store.turns.pop(key, None) is None:
                self._workers.reject(key)
        self._save()

    def exclude_repeated(self, repeated: Mapping[TurnId, TurnId]) -> None:
        """Let turns not count that show the same pictures as another one: once is enough."""
        self.warnings += [_repeated(turn, other) for turn, other in sorted(repeated.items())]
        self.exclude({turn: f'shows the same pictures as {other}, which counts'
                      for turn, other in repeated.items()})

    def left_out(self) -> dict[TurnId, str]:
        """Return why turns that were tried are without a scene now, in words."""
        built = self._workers.scenes()
        failed = {turn: NO_SCENE for turn, scene in built.items() if scene is None}
        alone = {} if len(failed) < len(built) else dict.fromkeys(self._store.turns, UNCONFIRMED)
        return failed | alone | self._excluded

    def chosen(self) -> list[Scene]:
        """Return the scenes that a calibration would use now, best first."""
        scenes = self.all_scenes()
        return [scenes[key] for key in self._best(scenes)]

    def turns_of(self, scenes: Iterable[Scene]) -> list[Scene]:
        """Return those of the scenes that are of turns, not of other stretches."""
        turns = {turn.id for turn in self._detection.turns()} | {
            key for key, turn in self._store.turns.items() if is_turn(turn.prominence)}
        return [scene for scene in scenes if scene.turn in turns]

    def _prominences(self) -> list[tuple[TurnId, float]]:
        """Return all turns that count, and the stored stretches; those of this drive first."""
        found = [(turn.id, turn.prominence) for turn in self._detection.turns()]
        return found + [(key, turn.prominence) for key, turn in self._store.turns.items()
                        if key not in self._excluded]

    def _ranked(self) -> list[TurnId]:
        """Return all turns that count, the most prominent first; those of earlier drives behind.

        These may be another camera's, and must not crowd out those of this drive.
        """
        return [key for *_, key in sorted((not key.of_this_drive, -prominence, key)
                                          for key, prominence in self._prominences()
                                          if is_turn(prominence))]

    def _best(self, among: Collection[TurnId]) -> list[TurnId]:
        """Return the turns to use, best first; none where none is of this drive."""
        ranked = [key for key in self._ranked() if key in among]
        own = [key for key in ranked if key.of_this_drive][:self._places + self._more]
        stretches = [turn.id for turn in self._other_stretches(len(own)) if turn.id in among]
        if not own and not stretches:
            return []
        found = own + [key for key in ranked if not key.of_this_drive][:max(
            self._places - len(own), 0)]
        if self._stretches or len(found) < self._places:
            # of drives that had too few turns, too
            earlier = [(-prominence, key) for key, prominence in self._prominences()
                       if not is_turn(prominence) and key in among]
            stretches += [key for _, key in sorted(earlier)]
        return found + stretches[:self.config.turns.stretches]

    def _other_stretches(self, turns: int) -> tuple[Turn, ...]:
        """Return the stretches to use beside so many turns of this drive."""
        few = self._stretches_wanted and turns < self._places
        return self._detection.stretches() if self._stretches or few else ()

    # turns -> scenes --------------------------------------------------------------------------

    def submit(self, more_to_come: bool = False, replace_failed: bool = False) -> None:
        """Have the best turns reconstructed; live: all, as a scene is a fiftieth of its images.

        more_to_come: the least of them wait, for better ones may take their places.
        replace_failed: turns that gave no scene are replaced by the next best. Only calibrations
        do that: which turns are reconstructed must not depend on the speed of the workers.
        """
        turns = {turn.id: turn for turn in self._detection.turns()}
        self._store.drop_repeated(turn.stamp_s for turn in turns.values())
        built = self._workers.scenes()
        # how many turns there are is known at the end of the drive
        count = sum(turn not in built or built[turn] is not None for turn in turns)
        stretches = () if more_to_come else self._other_stretches(count)
        turns |= {turn.id: turn for turn in self._detection.stretches()}
        self._workers.keep_only(set(turns))
        self._excluded = {key: why for key, why in self._excluded.items()
                          if key in turns or key in self._store.turns}
        # the mask of when a turn was found: what waits must not change its scene
        now = self._detection.valid()
        self._valid = {key: self._valid.get(key, now) for key in turns}
        places, ready = self._places + self._more, []
        for key in self._ranked():
            turn = turns.get(key)
            if turn is not None and (places > 0 or self._live) and turn.frames:
                ready.append(turn)
            if not (replace_failed and key in built and built[key] is None):
                places -= 1
        ready += [turn for turn in stretches if turn.frames]
        if ready:
            self._workers.start()
        waiting = WAITING if more_to_come and not self._live else 0
        due = ready[:max(len(ready) - waiting, 0)]
        for turn in due:
            self._workers.submit(turn, self._valid[turn.id])
            self._detection.release(turn.center)
        if not self._live:
            held = {turn.id for turn in self._detection.turns() if turn.frames}
            for key in held - self._in_a_file - {turn.id for turn in due}:
                self._set_aside(turns[key])

    def submit_stretch(self) -> None:
        """Have another stretch of a live drive reconstructed, where workers have nothing to do.

        None once a single turn is missing: that one must not wait for a worker.
        """
        few = (self._stretches_wanted
               and len(self._detection.turns()) < max(self._places - 1, 1))
        self._detection.want_stretches(few)
        if few and not self._workers.unbuilt():
            for turn in self._detection.stretches():
                if turn.frames:
                    self._workers.submit(turn, self._detection.valid())
                    self._detection.release(turn.center)

    def _set_aside(self, turn: Turn) -> None:
        images = in_a_file([frame.image for frame in turn.frames])
        self._detection.exchange(turn.center, tuple(
            replace(frame, image=image)
            for frame, image in zip(turn.frames, images, strict=True)))
        self._in_a_file.add(turn.id)

    def make_room(self) -> None:
        """Wait, unless live, until few turns wait in memory; raises what a worker raised."""
        if not self._live:
            # one beside those that the workers have: the detection goes on, and none of them idles
            self._workers.wait(lambda: len(self._workers.unbuilt()) <= self.config.threads + 1)

    def wanted(self, progress: Progress, final: bool) -> list[Scene]:
        """Wait for the best turns' scenes and return them, the best first.

        final: the drive is over. progress: called with the stage and the share done. Raises what
        a worker raised, and WorkerError when closed meanwhile.
        """
        # wait for all turns, also those that are not used: the report must not depend on the
        # speed of the workers
        everything = final or not self._live
        while True:
            total = max(len(self._workers.unbuilt()), 1)

            def ready(total: int = total) -> bool:
                waiting = len(self._workers.unbuilt())
                progress('reconstructing turns', max(0.0, 1 - waiting / total))
                return waiting == 0 if everything or not waiting else not self._undecided()

            self._workers.wait(ready)
            if self._workers.closed:
                raise WorkerError('E-CALIBRATOR-CLOSED',
                                  'the calibrator was closed while it calibrated')
            # only when all are done: what is submitted must not depend on the workers' speed
            own = [scene for scene in self._workers.scenes().values() if scene is not None]
            self._store.drop_repeated((), own)
            self.submit(replace_failed=True)
            self.store_new()
            if not (self._undecided() or (everything and self._workers.unbuilt())):
                self.stored_before = self.stored()
                return self.chosen()

    def _undecided(self) -> bool:
        """Return whether a turn that is not built yet may be among the best."""
        unbuilt = self._workers.unbuilt()
        return any(key in unbuilt for key in self._best({*unbuilt, *self.all_scenes()}))

    def all_scenes(self) -> dict[TurnId, Scene]:
        """Return all scenes, those of earlier drives too."""
        own = {key: scene for key, scene in self._workers.scenes().items() if scene is not None}
        return {**own, **{key: turn.scene for key, turn in self._store.turns.items()}}

    def built(self) -> Collection[Scene | None]:
        """Return the results of this drive's turns: scenes, None for a turn that gave none."""
        return self._workers.scenes().values()

    # turns.store ------------------------------------------------------------------------------

    def stored(self) -> tuple[StoredTurn, ...]:
        """Return the turns of earlier drives."""
        return tuple(self._store.turns.values())

    def store_new(self) -> None:
        """Write scenes that were built since the last call to turns.store."""
        built = {turn for turn, scene in self._workers.scenes().items() if scene is not None}
        if not built <= self._written:
            self._save()

    def forget_stored(self, but: Set[TurnId] = frozenset()) -> None:
        """Drop the turns of earlier drives but these, on disk too: for a camera that changed."""
        for key in self._store.turns.keys() - but:
            del self._store.turns[key]
        self._save()

    def clear_store(self) -> None:
        """Remove the turns of this drive and the loaded ones from turns.store; store no others."""
        self._store.clear()

    def _save(self) -> None:
        """Write the present scenes to turns.store; of two cameras in a stream there are none."""
        built = self._workers.scenes() if self._detection.other_camera is None else {}
        self._written = self._workers.scenes().keys()
        everything = (*self._detection.turns(), *self._detection.stretches())
        own = {turn.id: StoredTurn(scene, turn.stamp_s, turn.prominence)
               for turn in everything if (scene := built.get(turn.id)) is not None}
        self._store.mirror({**self._store.turns, **own})

    def _store_failed(self, notice: Notice) -> None:
        self.warnings.append(notice)
        self._warn(notice)


def _repeated(turn: TurnId, other: TurnId) -> Notice:
    return Notice('E-TURN-REPEATED', f'{turn} repeats {other}: it shows the same place in the '
                  f'same pictures, and counts once; is the recording played in a loop?')
