"""The turns that wait for a worker: which one is next, and when a failed one is tried again."""
from __future__ import annotations

import time
from collections.abc import Set
from dataclasses import dataclass, replace

from dashcalib_ros.arrays import Mask
from dashcalib_ros.detect.turn import Turn, TurnId
from dashcalib_ros.reconstruct.scene import Draft

# s; before the second attempt, doubled before each further one
BACK_OFF_S = 1.0
LONGEST_BACK_OFF_S = 60.0


@dataclass(frozen=True)
class Job:
    """A turn to be reconstructed, and where its pictures show no ego vehicle (None: everywhere).

    draft: the result of the first half of the work, if done. failures: how often it failed.
    not_before: when to try again, in s of time.monotonic().
    """

    turn: Turn
    valid: Mask | None
    draft: Draft | None = None
    failures: int = 0
    not_before: float = 0.0

    @property
    def name(self) -> str:
        """Return the turn's name, for messages."""
        return str(self.turn.id)

    def drafted(self, draft: Draft) -> Job:
        """Return the job for the second half, with only the images that it needs."""
        keyframes = set(draft.tracks.frames.tolist())
        frames = tuple(frame for frame in self.turn.frames if frame.index in keyframes)
        return Job(replace(self.turn, frames=frames), self.valid, draft)

    def failed(self) -> Job:
        """Return the job after one more failure, with the time of the next attempt."""
        failures = self.failures + 1
        return replace(self, failures=failures,
                       not_before=time.monotonic() + back_off_s(failures))


def back_off_s(failures: int) -> float:
    """Return how long to wait after so many failures, at least one."""
    return min(BACK_OFF_S * 2.0**min(failures - 1, 30), LONGEST_BACK_OFF_S)


class Jobs:
    """The jobs by their turn; for one thread at a time.

    most: how many there may be; None: any number. With a limit, in a live drive, the most
    prominent turn comes first. Else drafts come before scenes, and longer turns before shorter
    ones, so that the workers end at about the same time.
    """

    def __init__(self, most: int | None) -> None:
        self._most = most
        self._jobs: dict[TurnId, Job] = {}

    def put(self, job: Job) -> Job | None:
        """Add a job; if there are too many, drop the least prominent one and return it."""
        self._jobs[job.turn.id] = job
        if self._most is None or len(self._jobs) <= self._most:
            return None
        worst = min(self._jobs.values(), key=lambda job: job.turn.prominence)
        return self._jobs.pop(worst.turn.id)

    def take(self) -> Job | None:
        """Take out the job that is next, None if none is due."""
        now = time.monotonic()
        due = [job for job in self._jobs.values() if job.not_before <= now]
        if not due:
            return None
        if self._most is not None:
            job = max(due, key=lambda job: job.turn.prominence)
        else:
            job = max(due, key=lambda job: (job.draft is None, job.turn.images))
        return self._jobs.pop(job.turn.id)

    def pause_s(self) -> float | None:
        """Return how long until the next job is due, s; None if no job waits for its time."""
        now = time.monotonic()
        return min((job.not_before - now for job in self._jobs.values() if job.not_before > now),
                   default=None)

    def turns(self) -> set[TurnId]:
        """Return the turns that wait."""
        return set(self._jobs)

    def keep_only(self, turns: Set[TurnId]) -> None:
        """Drop the jobs of all other turns, with their images."""
        self._jobs = {turn: job for turn, job in self._jobs.items() if turn in turns}
