"""What a task takes: for people who plan larger fleets; in no table."""
from __future__ import annotations

import resource
import time
from dataclasses import dataclass


@dataclass(frozen=True)
class Effort:
    """What a task took: s of processor and wall time, MB of memory of its process at the most.

    again: the result was there already.
    """

    cpu_s: float
    wall_s: float
    peak_mb: float
    again: bool = False


class Clock:
    """Measures what a task takes."""

    def __init__(self) -> None:
        self._cpu, self._wall = time.process_time(), time.monotonic()

    def effort(self, again: bool = False) -> Effort:
        """Return what was taken since this clock was made."""
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        return Effort(time.process_time() - self._cpu, time.monotonic() - self._wall, peak, again)
