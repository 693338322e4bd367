# SPDX-License-Identifier: Apache-2.0
"""The child process: answers, errors, and every way for either side to die."""
from __future__ import annotations

import errno
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import child_tasks
import numpy as np
import pytest
from refused import refused
from waiting import LIMIT_S, background, is_running, wait_for

from dashcalib_ros.errors import InputError, WorkerError
from dashcalib_ros.workers import child as child_module
from dashcalib_ros.workers.child import ChildWorker
from dashcalib_ros.workers.worker import WorkerDiedError

ROOT = Path(__file__).parents[2]


@pytest.fixture
def child() -> Iterator[ChildWorker]:
    child = ChildWorker()
    yield child
    child.close()


def test_a_result_comes_back_and_the_process_stays(child):
    assert child.pid is None
    assert child.call(child_tasks.add, 2, 3) == 5
    pid = child.pid
    assert pid != os.getpid() and child.call(child_tasks.pid) == pid
    big = np.arange(3_000_000.0)
    np.testing.assert_array_equal(child.call(child_tasks.echo, big), big)
    assert child.pid == pid


@pytest.mark.parametrize(('kind', 'expected', 'text'), [
    ('input', InputError, 'drive one'),
    # not to be taken for a child that died
    ('os', FileNotFoundError, 'gone'), ('eof', EOFError, 'end'), ('value', ValueError, 'odd'),
    # what cannot travel says at least what it was
    ('awkward', WorkerError, 'AwkwardError: 1 of 2'),
    ('local', WorkerError, 'LocalError: made here')])
def test_what_the_function_raises_is_raised_here(child, kind, expected, text):
    with pytest.raises(expected, match=text) as caught:
        child.call(child_tasks.fail, kind)
    assert not isinstance(caught.value, WorkerDiedError)
    code = {InputError: 'E-NO-TURN', WorkerError: 'E-UNEXPECTED'}.get(expected)
    assert getattr(caught.value, 'code', None) == code
    pid = child.pid
    assert child.call(child_tasks.pid) == pid


def test_progress_is_told_in_order(child):
    told = []
    assert child.call(child_tasks.count, 4, progress=lambda *report: told.append(report)) == 4
    assert told == [(f'step {n}', n / 4) for n in range(4)]
    # and the next call has none
    assert child.call(child_tasks.add, 1, 1) == 2


def test_progress_that_raises_does_not_shift_the_answers(child):
    def stop(stage: str, done: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        child.call(child_tasks.count, 3, progress=stop)
    assert child.call(child_tasks.add, 40, 2) == 42


def test_kill_in_mid_call_and_again(child, tmp_path):
    flag = tmp_path / 'started'
    with background(lambda: child.call(child_tasks.sleep, 60, flag)) as outcome:
        wait_for(flag.exists)
        pid = child.pid
        child.kill()
    assert isinstance(outcome[0], WorkerDiedError)
    assert not is_running(pid) and child.pid is None
    assert child.call(child_tasks.add, 1, 2) == 3
    assert child.pid != pid


@pytest.mark.parametrize('how', [signal.SIGKILL, signal.SIGTERM, signal.SIGABRT])
def test_killed_from_outside(child, tmp_path, how):
    flag = tmp_path / 'started'
    with background(lambda: child.call(child_tasks.sleep, 60, flag)) as outcome:
        wait_for(lambda: flag.exists() and flag.read_text())
        os.kill(int(flag.read_text()), how)
    assert isinstance(outcome[0], WorkerDiedError) and outcome[0].code == 'E-WORKER-DIED'
    assert f'exit code {-how}' in str(outcome[0]) and 'scene.tracks' in str(outcome[0])
    assert child.call(child_tasks.add, 1, 2) == 3


def test_killed_between_calls(child):
    child.call(child_tasks.pid)
    os.kill(child.pid, signal.SIGKILL)
    wait_for(lambda: child.pid is None)
    assert child.call(child_tasks.add, 1, 2) == 3


@pytest.mark.parametrize('task', [child_tasks.die, child_tasks.abort])
def test_a_function_that_ends_its_process(child, task):
    for _ in range(2):
        with pytest.raises(WorkerDiedError):
            child.call(task)
    assert child.call(child_tasks.add, 1, 2) == 3


def test_ctrl_c_at_the_terminal_is_the_parents_business(child):
    child.call(child_tasks.pid)
    pid = child.pid
    os.kill(pid, signal.SIGINT)
    assert child.call(child_tasks.pid) == pid


def test_an_answer_that_cannot_be_pickled(child):
    with pytest.raises(TypeError, match='pickle'):
        child.call(child_tasks.unpicklable)
    assert child.call(child_tasks.add, 1, 2) == 3


def test_arguments_that_cannot_be_pickled(child):
    child.call(child_tasks.pid)
    pid = child.pid
    with pytest.raises(TypeError, match='pickle'):
        child.call(child_tasks.echo, threading.Lock())
    assert child.call(child_tasks.pid) == pid


def test_a_function_that_the_child_does_not_know(child, monkeypatch):
    ghost = type(child_tasks)('ghost_of_a_module')
    exec('def haunt(): return 1', ghost.__dict__)
    monkeypatch.setitem(sys.modules, 'ghost_of_a_module', ghost)
    with pytest.raises(ModuleNotFoundError, match='ghost_of_a_module'):
        child.call(ghost.haunt)
    assert child.call(child_tasks.add, 1, 2) == 3


def test_printing_does_not_disturb_the_answers(child):
    assert child.call(child_tasks.print_much) == 'answer'
    assert child.call(child_tasks.add, 1, 2) == 3


def test_files_in_the_current_folder_are_not_taken_for_modules(child, tmp_path, monkeypatch):
    for name in ('random', 'numpy', 'queue', 'struct'):
        (tmp_path / f'{name}.py').write_text('raise SystemExit("the wrong one")')
    monkeypatch.chdir(tmp_path)
    assert child.call(child_tasks.add, 1, 2) == 3


def test_a_process_that_cannot_be_started_is_one_line(child, monkeypatch):
    def full(*arguments, **options):
        raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
    monkeypatch.setattr(child_module.subprocess, 'Popen', full)
    with refused(WorkerError, 'E-WORKER-CANNOT-START'):
        child.call(child_tasks.pid)
    monkeypatch.undo()
    assert child.call(child_tasks.add, 1, 2) == 3


def test_low_priority():
    polite = ChildWorker(low_priority=True)
    try:
        assert polite.call(child_tasks.niceness) == min(os.nice(0) + 10, 19)
    finally:
        polite.close()


def test_close_is_for_good(child, tmp_path):
    flag = tmp_path / 'started'
    with background(lambda: child.call(child_tasks.sleep, 60, flag)) as outcome:
        wait_for(flag.exists)
        pid = child.pid
        child.close()
    assert isinstance(outcome[0], WorkerDiedError)
    assert not is_running(pid)
    with refused(WorkerDiedError, 'E-CALIBRATOR-CLOSED'):
        child.call(child_tasks.add, 1, 2)
    child.close()


PARENT = """
import sys
sys.path[:0] = [{test!r}, {root!r}]
import child_tasks
from dashcalib_ros.workers.child import ChildWorker
ChildWorker().call(child_tasks.sleep, 60, {flag!r})
"""


def test_the_child_ends_when_its_parent_is_killed_in_mid_call(tmp_path):
    flag = tmp_path / 'started'
    script = PARENT.format(test=str(ROOT / 'test'), root=str(ROOT), flag=str(flag))
    parent = subprocess.Popen([sys.executable, '-c', script])
    try:
        wait_for(lambda: flag.exists() and flag.read_text())
        pid = int(flag.read_text())
        assert is_running(pid) and pid != parent.pid
    finally:
        parent.kill()
        parent.wait(LIMIT_S)
    wait_for(lambda: not is_running(pid), 10.0)


def test_opencv_has_as_many_threads_as_allowed():
    for child, allowed in ((ChildWorker(), 1), (ChildWorker(threads=2), 2)):
        assert child.call(child_tasks.threads) == allowed
        child.close()


def test_arrays_travel_beside_the_pickle_and_can_be_written_to(child):
    arrays = [np.arange(6.0).reshape(2, 3), np.zeros((0, 3)), np.arange(9)[::2],
              np.asfortranarray(np.eye(3))]
    for sent, back in zip(arrays, child.call(child_tasks.echo, arrays), strict=True):
        assert np.array_equal(sent, back) and sent.shape == back.shape and back.flags.writeable


@pytest.fixture
def impatient(monkeypatch) -> None:
    monkeypatch.setattr(child_module, 'LOOK_S', 0.5)
    monkeypatch.setattr(child_module, 'LOOKS_TO_REPORT', 2)
    monkeypatch.setattr(child_module, 'LOOKS_TO_KILL', 4)


@pytest.mark.parametrize('size', [1, 1_000_000], ids=['at work', 'while it is sent its work'])
def test_a_child_that_is_stopped_is_told_of_and_ended(impatient, size):
    told: list[str] = []
    child = ChildWorker(on_trouble=told.append)
    try:
        pid = child.call(child_tasks.pid)
        os.kill(pid, signal.SIGSTOP)
        with refused(WorkerDiedError, 'E-WORKER-HANGS', pid, '2 s'):
            child.call(child_tasks.echo, np.zeros(size))
        assert len(told) == 1 and re.search(f'{pid} .* 1 s;', told[0])
        assert not is_running(pid)
        assert child.call(child_tasks.add, 1, 2) == 3
    finally:
        child.close()


def test_a_child_that_works_long_is_left_alone(impatient):
    told: list[str] = []
    child = ChildWorker(on_trouble=told.append)
    try:
        # longer than a hung one would live
        assert child.call(child_tasks.compute, 3.0) == 'computed'
        assert told == []
    finally:
        child.close()


def test_a_child_that_goes_on_in_time_keeps_its_work(impatient, monkeypatch):
    monkeypatch.setattr(child_module, 'LOOKS_TO_KILL', 1000)
    told: list[str] = []
    child = ChildWorker(on_trouble=told.append)
    try:
        pid = child.call(child_tasks.pid)
        os.kill(pid, signal.SIGSTOP)
        with background(lambda: child.call(child_tasks.pid)) as outcome:
            wait_for(lambda: told)
            os.kill(pid, signal.SIGCONT)
        assert outcome == [pid] and len(told) == 1
    finally:
        child.close()


STOPPED = """
import os, signal, sys, threading, time
sys.path[:0] = [{test!r}, {root!r}]
import child_tasks
from dashcalib_ros.workers import child as child_module
child_module.LOOK_S, child_module.LOOKS_TO_REPORT, child_module.LOOKS_TO_KILL = 0.5, 2, 4
told = []
child = child_module.ChildWorker(on_trouble=told.append)
child.call(child_tasks.pid)
print(child.pid, flush=True)
print(child.call(child_tasks.compute, 1.0), told, flush=True)
"""


def test_a_parent_that_was_stopped_itself_blames_nobody(tmp_path):
    """As when the machine is suspended, or Ctrl-Z at the terminal: all stand still."""
    script = STOPPED.format(test=str(ROOT / 'test'), root=str(ROOT))
    parent = subprocess.Popen([sys.executable, '-c', script], stdout=subprocess.PIPE, text=True,
                              start_new_session=True)
    try:
        assert int(parent.stdout.readline())
        os.killpg(parent.pid, signal.SIGSTOP)
        time.sleep(3.0)
        os.killpg(parent.pid, signal.SIGCONT)
        assert parent.stdout.readline() == 'computed []\n'
        assert parent.wait(LIMIT_S) == 0
    finally:
        parent.kill()
        parent.wait()
        parent.stdout.close()


def test_close_leaves_no_pipe_open(child):
    child.call(child_tasks.pid)
    process = child._process
    child.close()
    assert process.stdin.closed and process.stdout.closed
