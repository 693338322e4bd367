"""Which turns are reconstructed, and which scenes a calibration uses."""
from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Set
from dataclasses import replace
from typing import Any

from dashcalib_ros.arrays import Mask
from dashcalib_ros.config import Config
from dashcalib_ros.detect import Turn, TurnId
from dashcalib_ros.detect.detection import Detection
from dashcalib_ros.errors import WorkerError
from dashcalib_ros.reconstruct.repeated import without_repeated
from dashcalib_ros.reconstruct.scene import Scene, TurnPicture
from dashcalib_ros.reconstruct.scene_file import Origin, StoredTurn
from dashcalib_ros.turn_store import TurnStore
from dashcalib_ros.workers.child import ChildWorker
from dashcalib_ros.workers.memory import in_a_file
from dashcalib_ros.workers.pool import ScenePool
from dashcalib_ros.workers.worker import InlineWorker, Worker

Progress = Callable[[str, float], None]
Use = Callable[..., Any]

# why a turn is not used, in words
NO_SCENE = ('its pictures gave no scene: too dark, blurred or empty to follow enough points, or '
            'the car hardly moved')
ALONE = 'this drive has no turn that could agree with it'
OTHER_CAMERA = 'the turns of this drive are of another camera'
# turns that wait for better ones; of KITTI 03 five are reconstructed then, not eight
WAITING = 3
# of a drive; after it one less waits: it will hardly be pushed aside
LATE = 0.6


class SceneSelection:
    """Lets the pool reconstruct the best turns; chooses scenes among these and stored turns.

    config: turns.wanted is what want() was told last. expected: how many frames the drive has,
    None where that is not known. warnings: about turns.store, and about turns that ended the
    workers.

    All methods are for the Calibrator's thread, but close(), which is for any.
    """

    def __init__(self, config: Config, detection: Detection,
                 live: bool = False, verbose: bool = False, use_stored: bool = True,
                 warn: Callable[[str], None] = lambda text: None, inline: bool = False,
                 on_trouble: Callable[[str], None] = lambda text: None,
                 on_wait: Callable[[], bool] | None = None) -> None:
        """live, use_stored, warn, inline, on_trouble, on_wait: as the Calibrator's."""
        self.warnings: list[str] = []
        self.expected: int | None = None
        # how many turns are used: more than wanted once these have left a result weak
        self._places = config.turns.wanted
        # turns of this drive that are used beyond that
        self._more = 0
        self.config = config
        self._detection = detection
        self._live = live
        self._use_stored = use_stored
        self._warn = warn
        self._on_trouble = on_trouble
        self._closed = False
        # whether the workers were told to load what they need
        self._loading = False
        if live:
            # nothing else runs during an import: while images come, some would be lost
            _load_judging()
        # the turns whose scenes were written to turns.store
        self._stored_turns: Set[TurnId] = frozenset()
        # the turns whose pictures are in files
        self._in_a_file: set[TurnId] = set()
        # where the ego vehicle is not, by turn
        self._valid: dict[TurnId, Mask | None] = {}
        # why turns were taken out
        self._rejected: dict[TurnId, str] = {}
        # turns of earlier drives that this drive contradicts; on disk they stay
        self._contradicted: set[TurnId] = set()
        turns = config.turns
        self._kept = TurnStore(turns.store, max(turns.capacity, turns.wanted), turns.half_width,
                               self._store_failed)
        self._stored_before: tuple[StoredTurn, ...] = ()

        def child() -> Worker:
            # the last turn, and a drive's only one, can use all cores
            return ChildWorker(live, verbose, config.threads, on_trouble)

        self._pool = ScenePool(config, InlineWorker if inline else child,
                               queue=turns.wanted if live else None, on_lost=self._lost,
                               on_trouble=on_trouble, keep_pictures=not live, on_wait=on_wait)

    def load(self, frame_id: str) -> None:
        """Load the turns of earlier drives, at the first frame: they must fit its size and id."""
        assert self._detection.size is not None
        self._kept.load(Origin(self._detection.size, self._detection.scale, frame_id),
                           self._use_stored)

    def want(self, turns: int, more: int = 0) -> None:
        """Use so many turns from the next calibration on, turns.capacity at the most.

        more: turns of this drive are used beyond those.
        """
        self._more = more
        if turns != self.config.turns.wanted:
            self.config = self.config.replace({'turns.wanted': turns})
            self._places = turns

    def submit(self, more_to_come: bool = False, replace_failed: bool = False) -> None:
        """Have the best turns reconstructed; live: all, as a scene is a fiftieth of its images.

        more_to_come: the least of them wait, for better ones may take their places.
        replace_failed: turns that gave no scene are replaced by the next best. Only calibrations
        do that: which turns are reconstructed must not depend on the speed of the workers.
        """
        turns = {turn.id: turn for turn in self._detection.turns()}
        self._kept.drop_repeated(turn.stamp_s for turn in turns.values())
        built = self._pool.scenes()
        self._pool.keep_only(set(turns))
        self._rejected = {key: why for key, why in self._rejected.items() if key in turns}
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
        if ready and not self._loading:
            self._loading = True
            for _ in range(self.config.threads):
                self._pool.begin(_load_all if self._live else _load_solving)
        late = self.expected is not None and self._detection.frames > LATE * self.expected
        waiting = 0 if self._live or not more_to_come else WAITING - late
        due = ready[:max(len(ready) - waiting, 0)]
        for turn in due:
            self._pool.submit(turn, self._valid[turn.id])
            self._detection.release(turn.center)
        if not self._live:
            held = {key for key, turn in turns.items() if turn.frames}
            for key in held - self._in_a_file - {turn.id for turn in due}:
                self._set_aside(turns[key])

    def _set_aside(self, turn: Turn) -> None:
        """Move the pictures of a turn that waits out of the memory."""
        images = in_a_file([frame.image for frame in turn.frames])
        self._detection.exchange(turn.center, tuple(
            replace(frame, image=image)
            for frame, image in zip(turn.frames, images, strict=True)))
        self._in_a_file.add(turn.id)

    def chosen(self) -> list[Scene]:
        """Return the scenes that a calibration would use now, best first."""
        scenes = self.all_scenes()
        return [scenes[key] for key in self._best(scenes)]

    def all_scenes(self) -> dict[TurnId, Scene]:
        """Return all scenes, those of earlier drives too."""
        own = {key: scene for key, scene in self._pool.scenes().items() if scene is not None}
        return {**own, **{key: turn.scene for key, turn in self._kept.turns.items()}}

    def built(self) -> Collection[Scene | None]:
        """Return the results of this drive's turns: scenes, None for a turn that gave none."""
        return self._pool.scenes().values()

    def pictures(self) -> dict[TurnId, TurnPicture]:
        """Return one picture of each turn that is done; none in a live drive."""
        return self._pool.pictures()

    def left_out(self) -> dict[TurnId, str]:
        """Return why turns that were tried are without a scene now, in words."""
        built = self._pool.scenes()
        failed = {turn: NO_SCENE for turn, scene in built.items() if scene is None}
        alone = {} if len(failed) < len(built) else dict.fromkeys(self._kept.turns, ALONE)
        return failed | alone | dict.fromkeys(self._contradicted, OTHER_CAMERA) | self._rejected

    def stored_before(self) -> tuple[StoredTurn, ...]:
        """Return the turns of earlier drives that the last wanted() had to choose from."""
        return self._stored_before

    def stored(self) -> tuple[StoredTurn, ...]:
        """Return the turns of earlier drives."""
        return tuple(self._kept.turns.values())

    def _ranked(self) -> list[TurnId]:
        """Return all turns, the most prominent first; those of earlier drives behind.

        These may be another camera's, and must not crowd out those that tell.
        """
        found = [(False, -turn.prominence, turn.id) for turn in self._detection.turns()]
        found += [(True, -turn.prominence, key) for key, turn in self._kept.turns.items()
                  if key not in self._contradicted]
        return [key for *_, key in sorted(found)]

    def _best(self, among: Collection[TurnId]) -> list[TurnId]:
        """Return the turns to use, best first; none where none is of this drive."""
        ranked = [key for key in self._ranked() if key in among]
        own = [key for key in ranked if key.of_this_drive][:self._places + self._more]
        return own + ranked[len(own):self._places] if own else []

    def _undecided(self) -> bool:
        """Return whether a turn that is not built yet may be among the best."""
        unbuilt = self._pool.unbuilt()
        return any(key in unbuilt for key in self._best({*unbuilt, *self.all_scenes()}))

    def make_room(self) -> None:
        """Wait, unless live, until few turns wait in memory; raises what a worker raised."""
        if not self._live:
            # one beside those that the workers have: the detection goes on, and none of them idles
            self._pool.wait(lambda: len(self._pool.unbuilt()) <= self.config.threads + 1)

    def wanted(self, tell: Progress, final: bool, use: Use) -> tuple[list[Scene], Any]:
        """Wait for the best turns' scenes; return them, and what a function makes of them.

        final: the drive is over. tell: is called with the stage and the share done. use: the
        function is run in a worker, with the config; None where there is no scene. Raises what a
        worker raised, and WorkerError when closed meanwhile.
        """
        # wait for all turns, also those that are not used: the report must not depend on the
        # speed of the workers
        everything = final or not self._live
        while True:
            total = max(len(self._pool.unbuilt()), 1)

            def ready(total: int = total) -> bool:
                waiting = len(self._pool.unbuilt())
                tell('reconstructing turns', max(0.0, 1 - waiting / total))
                if everything or not waiting:
                    return waiting == 0
                return not self._undecided()

            self._pool.wait(ready)
            if self._closed:
                raise WorkerError('E-CALIBRATOR-CLOSED',
                                  'the calibrator was closed while it calibrated')
            # only when all are done: what is submitted must not depend on the workers' speed
            own = [scene for scene in self._pool.scenes().values() if scene is not None]
            self._kept.drop_repeated((), own)
            self.submit(replace_failed=True)
            ready_now = not self._undecided() and not (everything and len(self._pool.unbuilt()))
            chosen = self.chosen() if ready_now else []
            self.store_new()
            if ready_now:
                kept, repeated, result = self._used(chosen, use, tell)
                if repeated:
                    # the next best turns take their places
                    self.warnings += [_repeated_text(turn, other)
                                      for turn, other in sorted(repeated.items())]
                    self.reject({turn: f'shows the same pictures as {other}, which counts'
                                 for turn, other in repeated.items()})
                    continue
                self._stored_before = self.stored()
                return kept, result

    def _used(self, scenes: list[Scene], use: Use, tell: Progress
              ) -> tuple[list[Scene], dict[TurnId, TurnId], Any]:
        """Return the scenes that repeat no other, what those repeat, and what use makes of all.

        Looking for repeated ones takes a second, and hardly ever finds one: meanwhile another
        worker uses them all.
        """
        if not scenes:
            return [], {}, None
        pool = self._pool
        looking = pool.begin(without_repeated, scenes, self.config.scene.min_images)
        using = pool.begin(use, scenes, self.config, tells=True)
        kept, repeated = pool.result(looking)
        # of one that is repeated in part, the rest is kept
        if repeated or any(len(one.tracks.frames) < len(other.tracks.frames)
                           for one, other in zip(kept, scenes, strict=True)):
            pool.drop(using)
            if repeated:
                return kept, repeated, None
            using = pool.begin(use, kept, self.config, tells=True)
        return kept, repeated, pool.result(using, tell)

    def widen(self) -> bool:
        """Use more turns, up to turns.at_most; return False if there are no more to use."""
        turns = self.config.turns
        most = max(turns.at_most, turns.wanted)
        if self._places >= most or len(self._ranked()) <= self._places:
            return False
        self._places = most
        return True

    def reject(self, reasons: Mapping[TurnId, str]) -> None:
        """Take out scenes that do not fit the others, each for a reason in words."""
        self._rejected.update(reasons)
        for key in reasons:
            if self._kept.turns.pop(key, None) is None:
                self._pool.reject(key)
        self._store()

    def leave_out(self, earlier: Set[TurnId]) -> None:
        """Use these turns of earlier drives no more in this drive; on disk they stay."""
        self._contradicted |= earlier

    def run(self, function: Callable[..., Any], *arguments: Any,
            progress: Progress | None = None) -> Any:
        """Run a stage in a worker, as soon as one is free, and return what it returns."""
        return self._pool.run(function, *arguments, progress=progress)

    def child_pids(self) -> list[int]:
        """Return the process ids of the children that run now."""
        return self._pool.pids()

    def store_new(self) -> None:
        """Write scenes that were built since the last call to turns.store."""
        built = {turn for turn, scene in self._pool.scenes().items() if scene is not None}
        if not built <= self._stored_turns:
            self._store()

    def _store(self) -> None:
        """Write the present scenes to turns.store; of two cameras in a stream there are none."""
        built = self._pool.scenes() if self._detection.other_camera is None else {}
        self._stored_turns = self._pool.scenes().keys()
        own = {turn.id: StoredTurn(scene, turn.stamp_s, turn.prominence)
               for turn in self._detection.turns() if (scene := built.get(turn.id)) is not None}
        self._kept.mirror({**self._kept.turns, **own})

    def forget_stored(self, but: Set[TurnId] = frozenset()) -> None:
        """Drop the turns of earlier drives but these, on disk too: for a camera that changed."""
        for key in self._kept.turns.keys() - but:
            del self._kept.turns[key]
        self._store()

    def clear_store(self) -> None:
        """Remove the turns of this drive and the loaded ones from turns.store; store no others."""
        self._kept.clear()

    def close(self) -> None:
        """End the workers; a wanted() in another thread raises WorkerError."""
        self._closed = True
        self._pool.close()

    def _store_failed(self, text: str) -> None:
        self.warnings.append(text)
        self._warn(text)

    def _lost(self, text: str) -> None:
        self.warnings.append(text)
        self._on_trouble(text)


def _load_solving() -> None:
    """Import what a child needs until the solution, COLMAP too."""
    import dashcalib_ros.reconstruct.build
    import dashcalib_ros.solve.joint  # noqa: F401


def _load_judging() -> None:
    """Import what judges a result, and what that may need: it takes half a second."""
    from scipy import optimize, special  # noqa: F401
    from scipy.spatial import transform  # noqa: F401

    import dashcalib_ros.judge.conclude  # noqa: F401


def _load_all() -> None:
    """Import what a child of a live drive may need until the result."""
    _load_judging()
    _load_solving()


def _repeated_text(turn: TurnId, other: TurnId) -> str:
    return (f'{turn} repeats {other}: it shows the same place in the same pictures, and counts '
            f'once; is the recording played in a loop?')
