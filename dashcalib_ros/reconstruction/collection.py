"""The scenes of this drive's turns and of earlier ones, and which of them are used."""
from __future__ import annotations

import threading
from collections.abc import Callable, Iterable

import numpy as np
import numpy.typing as npt

from dashcalib_ros.config import Config
from dashcalib_ros.errors import WorkerError
from dashcalib_ros.reconstruction.archive import Archive, Origin, StoredTurn
from dashcalib_ros.reconstruction.scene import Scene
from dashcalib_ros.reconstruction.workshop import Workshop
from dashcalib_ros.turns.detector import TurnDetector

Mask = npt.NDArray[np.bool_]
Progress = Callable[[str, float], None]


class SceneCollection:
    """Has the best turns of the detector's bank built, and chooses among them and stored ones.

    places: how many turns are used. detector, valid: whose turns, and where their pictures show
    no ego vehicle; read with the lock only. workshop: builds the scenes. warnings: of turns.store,
    and of turns that ended the children.

    Threads: the Calibrator's lock guards the detector, the places and the archive's turns. It is
    held for moments: push() needs it for each frame. Nobody waits with it for a child, nor for a
    file (but for load(), once). load(), submit(), chosen() and stored() are for who has it; all
    other methods take it where they need it, and who calls them must not have it. Locks are taken
    in one order: the archive's (of its files), this one, the workshop's. The workshop's threads
    come to store() with none.
    """

    def __init__(self, config: Config, detector: TurnDetector, valid: Callable[[], Mask | None],
                 lock: threading.Lock, live: bool = False, verbose: bool = False,
                 warn: Callable[[str], None] = lambda text: None) -> None:
        """live, warn: as the Calibrator's."""
        self.detector = detector
        self.valid = valid
        # more than wanted once these have left a result weak
        self.places = config.turns.wanted
        self.warnings: list[str] = []
        self._config = config
        self._lock = lock
        self._live = live
        self._warn = warn
        self._closed = False
        turns = detector.config
        self._archive = Archive(turns.store, turns.capacity, turns.half_width, self._on_trouble)
        self.workshop = Workshop(config, low_priority=live, verbose=verbose,
                                 queue=turns.wanted if live else None, on_built=self.store,
                                 on_lost=self.warnings.append)

    # for who has the lock

    def load(self, origin: Origin, use_stored: bool) -> None:
        """Find the turns of earlier drives, now that it is known what the images are."""
        self._archive.load(origin, use_stored)

    def submit(self, replace_failed: bool = False) -> None:
        """Have the best turns built; live, all: a scene is a fiftieth of its images.

        A turn's images are chosen for good when it is confirmed, and not when it is built: what
        becomes of turns that overlap it must depend neither on how fast the children are, nor on
        whether the drive is live. For the same reason others are tried in the place of turns that
        gave no scene only when a calibration is asked for (replace_failed).
        """
        turns = {turn.center: turn for turn in self.detector.turns()}
        self._archive.drop_repeated(turn.stamp_s for turn in turns.values())
        built = self.workshop.scenes()
        self.workshop.keep_only(set(turns))
        places = self.places
        for key in self._ranked():
            turn = turns.get(key)
            if turn is not None and (places > 0 or self._live) and turn.frames:
                self.workshop.submit(turn, self.valid())
                self.detector.release(key)
            elif turn is not None:
                self.detector.fix(key)
            if not (replace_failed and key in built and built[key] is None):
                places -= 1

    def chosen(self) -> list[Scene]:
        """Return the scenes that a calibration would use now, best first."""
        return self._built()[:self.places]

    def stored(self) -> tuple[StoredTurn, ...]:
        """Return the turns of earlier drives; their scenes' centres are negative."""
        return tuple(self._archive.turns.values())

    def _ranked(self) -> list[int]:
        """Return all turns, the most prominent first: this drive's by their centres."""
        found = [(-turn.prominence, turn.center) for turn in self.detector.turns()]
        found += [(-turn.prominence, key) for key, turn in self._archive.turns.items()]
        return [key for _, key in sorted(found)]

    def _built(self) -> list[Scene]:
        """Return the scenes there are, best first: a turn without one gives way to the next."""
        scenes = {**self.workshop.scenes(),
                  **{key: turn.scene for key, turn in self._archive.turns.items()}}
        return [scene for key in self._ranked() if (scene := scenes.get(key)) is not None]

    def _undecided(self) -> bool:
        """Tell whether a turn that is not built yet may be among the best."""
        unbuilt = self.workshop.unbuilt()
        built = {scene.center for scene in self._built()}
        candidates = [key for key in self._ranked() if key in unbuilt or key in built]
        return any(key in unbuilt for key in candidates[:self.places])

    # for who does not have the lock

    def make_room(self) -> None:
        """Wait, unless live, until few turns are in memory; raises what a child raised."""
        if not self._live:
            self.workshop.wait(lambda: self.workshop.waiting <= 2 * self._config.threads)

    def wanted(self, tell: Progress, final: bool
               ) -> tuple[list[Scene], tuple[StoredTurn, ...]]:
        """Wait for the best turns' scenes; return them, and the stored turns they were among.

        final: the drive is over. tell: of the share done. Raises what a child raised, and
        WorkerError when closed meanwhile.
        """
        # for the scenes of the others, too: what is told of turns that are not used must not
        # depend on who is first
        everything = final or not self._live
        while True:
            total = max(self.workshop.waiting, 1)

            def ready(total: int = total) -> bool:
                waiting = self.workshop.waiting
                tell('reconstructing turns', max(0.0, 1 - waiting / total))
                if everything or not waiting:
                    return waiting == 0
                with self._lock:
                    return not self._undecided()

            self.workshop.wait(ready)
            if self._closed:
                raise WorkerError('the calibrator was closed while it calibrated')
            with self._lock:
                # only now: what is submitted meanwhile must not depend on the children's speed
                own = [scene for scene in self.workshop.scenes().values() if scene is not None]
                self._archive.drop_repeated((), own)
                self.submit(replace_failed=True)
                if not self._undecided() and not (everything and self.workshop.waiting):
                    return self.chosen(), self.stored()

    def widen(self) -> bool:
        """Give places to more turns, up to turns.at_most; False where no more turns have one."""
        turns = self._config.turns
        most = max(turns.at_most, turns.wanted)
        with self._lock:
            if self.places >= most or len(self._ranked()) <= self.places:
                return False
            self.places = most
            return True

    def reject(self, keys: Iterable[int]) -> None:
        """Take out scenes that do not fit the others."""
        with self._lock:
            for key in keys:
                if self._archive.turns.pop(key, None) is None:
                    self.workshop.reject(key)

    def store(self) -> None:
        """Have turns.store hold the scenes there are; the workshop calls it for each new one."""
        def snapshot() -> dict[int, StoredTurn]:
            with self._lock:
                built = self.workshop.scenes()
                own = {turn.center: StoredTurn(scene, turn.stamp_s, turn.prominence)
                       for turn in self.detector.turns()
                       if (scene := built.get(turn.center)) is not None}
                return {**self._archive.turns, **own}

        self._archive.mirror(snapshot)

    def forget_stored(self) -> None:
        """Drop the turns of earlier drives, on disk too."""
        with self._lock:
            self._archive.turns.clear()
        self.store()

    def clear_store(self) -> None:
        """Remove all turns of this drive and those found from turns.store; store no others."""
        self._archive.clear()

    def close(self) -> None:
        """End the children; a wanted() in another thread raises WorkerError."""
        self._closed = True
        self.workshop.close()

    def _on_trouble(self, text: str) -> None:
        self.warnings.append(text)
        self._warn(text)
