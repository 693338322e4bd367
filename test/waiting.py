# SPDX-License-Identifier: Apache-2.0
"""Waiting in tests: for a condition, and for what runs in a thread meanwhile."""
from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

LIMIT_S = 20.0


def wait_for(condition: Callable[[], object], limit_s: float = LIMIT_S) -> None:
    end = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end, 'waited in vain'
        time.sleep(0.02)


def is_running(pid: int) -> bool:
    try:
        state = Path(f'/proc/{pid}/stat').read_text().rsplit(')', 1)[1].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state != 'Z'


@contextlib.contextmanager
def background(function: Callable[[], object]) -> Iterator[list[object]]:
    """Run something in a thread meanwhile; the list gets what it returned or raised."""
    outcome: list[object] = []

    def run() -> None:
        try:
            outcome.append(function())
        except Exception as error:
            outcome.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    yield outcome
    thread.join(LIMIT_S)
    assert not thread.is_alive(), 'it hangs'
