# SPDX-License-Identifier: Apache-2.0
"""Which turns are reconstructed, and which scenes a calibration uses."""
from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Set
from dataclasses import dataclass

from dashcalib_ros.arrays import Mask
from dashcalib_ros.config import Config
from dashcalib_ros.detect import Turn, TurnId
from dashcalib_ros.detect.detection import Detection
from dashcalib_ros.detect.turn import is_turn
from dashcalib_ros.errors import Notice
from dashcalib_ros.reconstruct.scene import BEND_DEG, Scene
from dashcalib_ros.report.turns import direction
from dashcalib_ros.store.scene_file import Origin, StoredTurn
from dashcalib_ros.store.turn_store import TurnStore
from dashcalib_ros.workers.pool import ScenePool

# why a turn is not used, in words
NO_SCENE = ('its pictures gave no scene: too dark, blurred or empty to follow enough points, or '
            'the car hardly moved')
UNCONFIRMED = 'this drive has no turn that could agree with it'
# turns that wait for better ones; of KITTI 03 five are reconstructed then, not eight
WAITING = 3


@dataclass(frozen=True)
class Status:
    """The calibrator's state after a frame.

    frames: pushed so far. turns: in the bank and stored. built: how many turns' scenes a
    calibration would use now; ready: these turns; yaw_deg: the sum of their yaw. stretches: of
    the drive besides that it would use; bends: how many of these have yaw. stored: how many turns
    are of earlier drives. magnitude: the newest filtered turning magnitude, of the image width.
    yaws_deg: of the turns in ready, in their order; ways: where these go, as direction() says.
    reconstructed: the turns that have scenes, chosen or not. two_cameras: what the newest images
    show, if they are of two.
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


@dataclass(frozen=True)
class Plan:
    """What is to be done with the turns of a drive.

    keep: the turns and stretches that still count; None: all. build: to be reconstructed, in this
    order, each with where the ego vehicle is not; their images are released then. set_aside: turns
    whose images wait in files.
    """

    keep: Set[TurnId] | None = None
    build: tuple[tuple[Turn, Mask | None], ...] = ()
    set_aside: tuple[Turn, ...] = ()


class SceneSelection:
    """Decides which turns are reconstructed and which scenes count, stored ones too.

    It only looks at the detection and the workers: the Calibrator carries out what it plans.
    config: turns.wanted is what want() was called with last. warnings: about turns.store, and
    about turns that repeat others. All methods are for the Calibrator's thread.
    """

    def __init__(self, config: Config, detection: Detection, workers: ScenePool,
                 live: bool = False, use_stored: bool = True,
                 warn: Callable[[Notice], None] = lambda notice: None) -> None:
        """live, use_stored, warn: as the Calibrator's."""
        self.config = config
        self.warnings: list[Notice] = []
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
        # those of this drive that count as turns without a scene
        self._rejected: set[TurnId] = set()
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
                self._rejected.add(key)
        self._save()

    def exclude_repeated(self, repeated: Mapping[TurnId, TurnId]) -> None:
        """Let turns not count that show the same pictures as another one: once is enough."""
        self.warnings += [_repeated(turn, other) for turn, other in sorted(repeated.items())]
        self.exclude({turn: f'shows the same pictures as {other}, which counts'
                      for turn, other in repeated.items()})

    def left_out(self) -> dict[TurnId, str]:
        """Return why turns that were tried are without a scene now, in words."""
        built = self.built()
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

    def plan(self, more_to_come: bool = False) -> Plan:
        """Choose the best turns for reconstruction; live: all, as a scene is small.

        more_to_come: the least of them wait, for better ones may take their places. Else turns
        that gave no scene are replaced by the next best; only when all are done, as which turns
        are reconstructed must not depend on the speed of the workers.
        """
        turns, built = {turn.id: turn for turn in self._detection.turns()}, self.built()
        self._store.drop_repeated(
            (turn.stamp_s for turn in turns.values()),
            () if more_to_come else (scene for scene in built.values() if scene is not None))
        # how many turns there are is known at the end of the drive
        count = sum(turn not in built or built[turn] is not None for turn in turns)
        stretches = () if more_to_come else self._other_stretches(count)
        turns |= {turn.id: turn for turn in self._detection.stretches()}
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
            if more_to_come or key not in built or built[key] is not None:
                places -= 1
        ready += [turn for turn in stretches if turn.frames]
        waiting = WAITING if more_to_come and not self._live else 0
        due = ready[:max(len(ready) - waiting, 0)]
        held = set() if self._live else {
            turn.id for turn in self._detection.turns() if turn.frames}
        aside = held - self._in_a_file - {turn.id for turn in due}
        self._in_a_file |= aside
        return Plan(turns.keys(), tuple((turn, self._valid[turn.id]) for turn in due),
                    tuple(turns[key] for key in aside))

    @property
    def few(self) -> bool:
        """Return whether a live drive has so few turns that other stretches are worth a worker.

        Not once a single turn is missing: that one must not wait for a worker.
        """
        return (self._stretches_wanted
                and len(self._detection.turns()) < max(self._places - 1, 1))

    def stretch_plan(self) -> Plan:
        """Choose other stretches of a live drive, where workers have nothing to do."""
        if not self.few or self._workers.unbuilt():
            return Plan()
        return Plan(build=tuple((turn, self._detection.valid())
                                for turn in self._detection.stretches() if turn.frames))

    def undecided(self) -> bool:
        """Return whether a turn that is not built yet may be among the best."""
        unbuilt = self._workers.unbuilt()
        return any(key in unbuilt for key in self._best({*unbuilt, *self.all_scenes()}))

    def all_scenes(self) -> dict[TurnId, Scene]:
        """Return all scenes, those of earlier drives too."""
        own = {key: scene for key, scene in self.built().items() if scene is not None}
        return {**own, **{key: turn.scene for key, turn in self._store.turns.items()}}

    def built(self) -> dict[TurnId, Scene | None]:
        """Return the results of this drive's turns: scenes, None for a turn that gave none."""
        return {key: None if key in self._rejected else scene
                for key, scene in self._workers.scenes().items()}

    def reconstructed(self) -> list[Scene]:
        """Return all scenes of turns, chosen or not, those of earlier drives too."""
        return self.turns_of(self.all_scenes().values())

    def status(self) -> Status:
        """Return the present state; scenes that are new are written to turns.store.

        Those of a drive of two cameras are not.
        """
        self.store_new()
        found, used, stored = self._detection, self.chosen(), len(self._store.turns)
        chosen = self.turns_of(used)
        turns = {scene.turn for scene in chosen}
        further = [scene for scene in used if scene.turn not in turns]
        return Status(
            found.frames, len(found.turns()) + stored, len(chosen),
            sum(scene.yaw_deg for scene in chosen), found.magnitude, found.standing,
            tuple(scene.turn for scene in chosen), stored,
            tuple(scene.yaw_deg for scene in chosen),
            tuple(scene.turn for scene in self.reconstructed()),
            str(found.other_camera) if found.mixed else '', tuple(map(direction, chosen)),
            tuple(scene.turn for scene in further),
            sum(scene.yaw_deg >= BEND_DEG for scene in further))

    # turns.store ------------------------------------------------------------------------------

    def stored(self) -> tuple[StoredTurn, ...]:
        """Return the turns of earlier drives."""
        return tuple(self._store.turns.values())

    def store_new(self) -> None:
        """Write scenes that were built since the last call to turns.store."""
        built = {turn for turn, scene in self.built().items() if scene is not None}
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
        built = self.built()
        self._written = built.keys()
        everything = (*self._detection.turns(), *self._detection.stretches())
        own = {turn.id: StoredTurn(scene, turn.stamp_s, turn.prominence)
               for turn in everything if (scene := built.get(turn.id)) is not None
               and self._detection.other_camera is None}
        self._store.mirror({**self._store.turns, **own})

    def _store_failed(self, notice: Notice) -> None:
        self.warnings.append(notice)
        self._warn(notice)


def _repeated(turn: TurnId, other: TurnId) -> Notice:
    return Notice('E-TURN-REPEATED', f'{turn} repeats {other}: it shows the same place in the '
                  f'same pictures, and counts once; is the recording played in a loop?')
