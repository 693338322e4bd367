# SPDX-License-Identifier: Apache-2.0
"""The worker without a process: the same answers and errors, one call at a time."""
from __future__ import annotations

import os
import threading

import child_tasks
import pytest
from waiting import background

from dashcalib_ros.errors import InputError, WorkerError
from dashcalib_ros.workers.worker import THREAD_VARIABLES, InlineWorker, Worker, WorkerDiedError


@pytest.fixture(autouse=True)
def one_thread_of_numpy(monkeypatch) -> None:
    for name in THREAD_VARIABLES:
        monkeypatch.setenv(name, '1')


def test_where_results_would_differ_it_says_what_to_set(monkeypatch):
    monkeypatch.setenv('OPENBLAS_NUM_THREADS', '2')
    with pytest.raises(WorkerError, match=' '.join(f'{name}=1' for name in THREAD_VARIABLES)
                       ) as caught:
        InlineWorker()
    assert caught.value.code == 'E-NUMPY-THREADS'


def test_it_calls_here_and_passes_on_progress_and_errors():
    worker: Worker = InlineWorker()
    told: list[tuple[str, float]] = []
    assert worker.call(child_tasks.pid) == os.getpid() and worker.pid is None
    assert worker.call(child_tasks.count, 2, progress=lambda *each: told.append(each)) == 2
    assert told == [('step 0', 0.0), ('step 1', 0.5)]
    with pytest.raises(InputError, match='drive one'):
        worker.call(child_tasks.fail, 'input')
    worker.close()
    with pytest.raises(WorkerDiedError) as caught:
        worker.call(child_tasks.pid)
    assert caught.value.code == 'E-CALIBRATOR-CLOSED'


def test_two_workers_never_work_at_the_same_time():
    at_work: list[int] = []
    together = threading.Event()
    begun = threading.Event()

    def work() -> None:
        at_work.append(1)
        begun.set()
        if len(at_work) > 1:
            together.set()
        together.wait(0.5)
        at_work.pop()

    with background(lambda: InlineWorker().call(work)):
        assert begun.wait(10)
        InlineWorker().call(work)
    assert not together.is_set() and not at_work
