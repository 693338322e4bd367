"""The child process: answers, errors, and every way for either side to die."""
from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import child_tasks
import cv2
import numpy as np
import pytest

from dashcalib_ros.config import Config
from dashcalib_ros.errors import InputError, WorkerError
from dashcalib_ros.frames import Frame
from dashcalib_ros.reconstruction import build
from dashcalib_ros.reconstruction import child as child_module
from dashcalib_ros.reconstruction import workshop as workshop_module
from dashcalib_ros.reconstruction.child import Child, ChildDiedError
from dashcalib_ros.reconstruction.workshop import ATTEMPTS, Workshop
from dashcalib_ros.turns.turn import Turn

ROOT = Path(__file__).parents[1]
LIMIT_S = 20.0


@pytest.fixture
def child() -> Iterator[Child]:
    child = Child()
    yield child
    child.close()


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


def test_a_result_comes_back_and_the_process_stays(child):
    assert child.pid is None
    assert child.call(child_tasks.add, 2, 3) == 5
    pid = child.pid
    assert pid != os.getpid() and child.call(child_tasks.pid) == pid
    big = np.arange(3_000_000.0)
    np.testing.assert_array_equal(child.call(child_tasks.echo, big), big)
    assert child.pid == pid


@pytest.mark.parametrize(('kind', 'expected', 'text'), [
    ('input', InputError, 'no turn: drive one'),
    # not to be taken for a child that died
    ('os', FileNotFoundError, 'gone'), ('eof', EOFError, 'end'), ('value', ValueError, 'odd'),
    # what cannot travel says at least what it was
    ('awkward', WorkerError, 'AwkwardError: 1 of 2'),
    ('local', WorkerError, 'LocalError: made here')])
def test_what_the_function_raises_is_raised_here(child, kind, expected, text):
    with pytest.raises(expected, match=text) as caught:
        child.call(child_tasks.fail, kind)
    assert not isinstance(caught.value, ChildDiedError)
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
    assert isinstance(outcome[0], ChildDiedError)
    assert not is_running(pid) and child.pid is None
    assert child.call(child_tasks.add, 1, 2) == 3
    assert child.pid != pid


@pytest.mark.parametrize('how', [signal.SIGKILL, signal.SIGTERM, signal.SIGABRT])
def test_killed_from_outside(child, tmp_path, how):
    flag = tmp_path / 'started'
    with background(lambda: child.call(child_tasks.sleep, 60, flag)) as outcome:
        wait_for(lambda: flag.exists() and flag.read_text())
        os.kill(int(flag.read_text()), how)
    assert isinstance(outcome[0], ChildDiedError)
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
        with pytest.raises(ChildDiedError):
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


def test_low_priority():
    polite = Child(low_priority=True)
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
    assert isinstance(outcome[0], ChildDiedError)
    assert not is_running(pid)
    with pytest.raises(ChildDiedError, match='closed'):
        child.call(child_tasks.add, 1, 2)
    child.close()


PARENT = """
import sys
sys.path[:0] = [{test!r}, {root!r}]
import child_tasks
from dashcalib_ros.reconstruction.child import Child
Child().call(child_tasks.sleep, 60, {flag!r})
"""


def test_the_child_ends_when_its_parent_is_killed_in_mid_call(tmp_path):
    flag = tmp_path / 'started'
    script = PARENT.format(test=str(Path(__file__).parent), root=str(ROOT), flag=str(flag))
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
    for child, allowed in ((Child(), 1), (Child(threads=2), 2)):
        assert child.call(child_tasks.threads) == allowed
        child.close()


# the workshop

@pytest.fixture
def workshop(monkeypatch) -> Iterator[Workshop]:
    monkeypatch.setattr(workshop_module, 'BACK_OFF_S', 0.01)
    workshop = Workshop(Config().replace({'threads': 2}))
    yield workshop
    workshop.close()


def turn(center: int, note: Path | str = '') -> Turn:
    return Turn(center, center - 5, center + 5, center / 10, 0.05, (str(note),))


def wait_until_built(workshop: Workshop) -> None:
    end = time.monotonic() + LIMIT_S
    workshop.wait(lambda: workshop.waiting == 0 or time.monotonic() > end)
    assert workshop.waiting == 0, 'waited in vain'


def use(monkeypatch, function: Callable[..., object]) -> None:
    monkeypatch.setattr(workshop_module, 'draft_turn', function)


def test_turns_become_scenes_once(workshop, monkeypatch):
    use(monkeypatch, child_tasks.build)
    for center in (10, 50, 90, 50):
        workshop.submit(turn(center), None)
    wait_until_built(workshop)
    assert workshop.scenes() == {center: f'scene of {center}' for center in (10, 50, 90)}
    assert all(child.pid is not None for child in workshop._children)


@pytest.mark.parametrize('error', [cv2.error('remap: dst is empty'),
                                   np.linalg.LinAlgError('Singular matrix')])
def test_a_hopeless_turn_has_no_scene_and_verbose_tells_why(monkeypatch, capsys, error):
    def fail(*arguments: object) -> None:
        raise error

    monkeypatch.setattr(build, 'draft_scene', fail)
    assert workshop_module.draft_turn(turn(10), Config(), None) is None
    # a child's stderr is the terminal with --verbose, and nowhere else
    told = capsys.readouterr().err
    assert 'turn at frame 10' in told and str(error) in told


def test_who_has_no_turn_left_starts_the_process_that_comes_next(workshop, monkeypatch, tmp_path):
    use(monkeypatch, child_tasks.build_slowly)
    workshop.submit(turn(10, tmp_path / 'flag'), None)
    wait_for((tmp_path / 'flag.10').exists)
    assert workshop._solver.pid is None
    use(monkeypatch, child_tasks.build)
    workshop.submit(turn(50), None)
    wait_for(lambda: workshop._solver.pid is not None)
    started = workshop._solver.pid
    assert workshop.unbuilt() == {10}
    assert workshop.run(child_tasks.pid) == started


def test_nobody_waits_for_a_solution_with_turns_to_build(workshop, monkeypatch, tmp_path):
    use(monkeypatch, child_tasks.build_slowly)
    workshop.submit(turn(10, tmp_path / 'flag'), None)
    wait_for((tmp_path / 'flag.10').exists)

    def solve() -> None:
        with contextlib.suppress(WorkerError):
            workshop.run(child_tasks.sleep, 2 * LIMIT_S, tmp_path / 's')

    solving = threading.Thread(target=solve, daemon=True)
    solving.start()
    wait_for((tmp_path / 's').exists)
    # as between two solutions, when the process of the last has died
    monkeypatch.setattr(type(workshop._solver), 'pid', None)
    use(monkeypatch, child_tasks.build)
    for center in (50, 90):
        workshop.submit(turn(center), None)
        wait_for(lambda center=center: center in workshop.scenes())
    assert workshop.unbuilt() == {10} and solving.is_alive()


def test_where_the_next_process_cannot_start_turns_are_still_built(workshop, monkeypatch):
    use(monkeypatch, child_tasks.build)
    monkeypatch.setattr(workshop_module, 'load_all', child_tasks.die)
    for center in (10, 50, 90):
        workshop.submit(turn(center), None)
    wait_until_built(workshop)
    assert set(workshop.scenes()) == {10, 50, 90}
    assert workshop.run(child_tasks.add, 1, 2) == 3


def test_without_a_queue_the_longest_is_built_first(monkeypatch, tmp_path):
    use(monkeypatch, child_tasks.build_slowly)
    workshop = Workshop(Config().replace({'threads': 1}))
    try:
        workshop.submit(turn(10, tmp_path / 'flag'), None)
        wait_for((tmp_path / 'flag.10').exists)
        use(monkeypatch, child_tasks.build)
        for center, images in ((20, 2), (30, 9), (40, 5)):
            workshop.submit(replace(turn(center), frames=('',) * images, prominence=1 / center),
                            None)
        workshop.keep_only({20, 30, 40})
        os.kill(int((tmp_path / 'flag.10').read_text()), signal.SIGKILL)
        wait_until_built(workshop)
        assert list(workshop.scenes()) == [30, 40, 20]
    finally:
        workshop.close()


def test_a_child_that_dies_loses_no_turn(workshop, monkeypatch, tmp_path):
    use(monkeypatch, child_tasks.build_dies_at_first)
    for center in (10, 50, 90):
        workshop.submit(turn(center, tmp_path / 'flag'), None)
    wait_until_built(workshop)
    assert workshop.scenes() == dict.fromkeys((10, 50, 90), 'second time')


def test_a_turn_whose_child_is_killed_from_outside_is_built_again(
        workshop, monkeypatch, tmp_path):
    use(monkeypatch, child_tasks.build_slowly)
    flag = tmp_path / 'flag.10'
    workshop.submit(turn(10, tmp_path / 'flag'), None)
    wait_for(lambda: flag.exists() and flag.read_text())
    use(monkeypatch, child_tasks.build)
    os.kill(int(flag.read_text()), signal.SIGKILL)
    wait_until_built(workshop)
    assert workshop.scenes() == {10: 'scene of 10'}


def test_a_turn_that_kills_every_child_is_given_up_and_told(monkeypatch, tmp_path):
    log, told = tmp_path / 'log', []
    use(monkeypatch, child_tasks.build_dies)
    workshop = Workshop(Config(), on_lost=told.append)
    workshop.submit(turn(10, log), None)
    wait_until_built(workshop)
    assert workshop.scenes() == {10: None}
    assert len(told) == 1 and 'turn at frame 10' in told[0]
    assert log.read_text() == '10\n' * ATTEMPTS
    # the others still are built
    use(monkeypatch, child_tasks.build)
    workshop.submit(turn(50), None)
    wait_until_built(workshop)
    assert workshop.scenes() == {10: None, 50: 'scene of 50'} and len(told) == 1
    workshop.close()


def test_where_no_child_can_live_the_pictures_are_not_blamed(workshop, monkeypatch):
    """A broken installation, say, or a library of another processor."""
    monkeypatch.setattr(workshop_module, 'ATTEMPTS', 2)
    monkeypatch.setattr(child_module, 'START', 'import sys; sys.exit(7)')
    workshop.submit(turn(10), None)
    with pytest.raises(WorkerError, match=r'no reconstruction process .*exit code 7'):
        wait_until_built(workshop)
    monkeypatch.undo()
    use(monkeypatch, child_tasks.build)
    wait_until_built(workshop)
    assert workshop.scenes() == {10: 'scene of 10'}


def test_an_error_is_told_once_and_the_turn_tried_again(workshop, monkeypatch, tmp_path):
    use(monkeypatch, child_tasks.build_fails_at_first)
    workshop.submit(turn(10, tmp_path / 'flag'), None)
    with pytest.raises(WorkerError, match='frame 10 failed: MemoryError: no room'):
        wait_until_built(workshop)
    assert workshop.waiting == 1
    wait_until_built(workshop)
    assert workshop.scenes() == {10: 'scene of 10'}


def test_scenes_of_turns_that_left_are_dropped(workshop, monkeypatch, tmp_path):
    use(monkeypatch, child_tasks.build)
    for center in (10, 50):
        workshop.submit(turn(center), None)
    wait_until_built(workshop)
    workshop.keep_only({50})
    assert workshop.scenes() == {50: 'scene of 50'}
    # also one that is not built yet
    use(monkeypatch, child_tasks.build_slowly)
    workshop.submit(turn(90, tmp_path / 'flag'), None)
    wait_for((tmp_path / 'flag.90').exists)
    workshop.keep_only({50})
    assert workshop.waiting == 0
    workshop.reject(50)
    assert workshop.scenes() == {50: None}


def test_the_most_prominent_is_built_first_and_the_queue_has_an_end(monkeypatch, tmp_path):
    use(monkeypatch, child_tasks.build_slowly)
    settled = threading.Semaphore(0)
    workshop = Workshop(Config().replace({'threads': 1}), queue=2, on_built=settled.release)
    try:
        workshop.submit(turn(10, tmp_path / 'flag'), None)
        wait_for((tmp_path / 'flag.10').exists)
        use(monkeypatch, child_tasks.build)
        for center, prominence in ((20, 0.02), (30, 0.03), (40, 0.01), (50, 0.04)):
            workshop.submit(replace(turn(center), prominence=prominence), None)
        # one is being built, two wait with their images
        assert set(workshop._jobs) == {30, 50} and workshop.unbuilt() == {10, 30, 50}
        assert workshop.scenes() == {20: None, 40: None}
        workshop.keep_only({20, 30, 40, 50})
        os.kill(int((tmp_path / 'flag.10').read_text()), signal.SIGKILL)
        wait_until_built(workshop)
        assert list(workshop.scenes().items())[2:] == [(50, 'scene of 50'), (30, 'scene of 30')]
        for _ in (10, 50, 30):
            assert settled.acquire(timeout=LIMIT_S)
        workshop.submit(turn(60), None)
        workshop.keep_only(set())
        assert not workshop._jobs and workshop.waiting == 0
    finally:
        workshop.close()


def filmed(center: int, images: int, log: Path) -> Turn:
    picture = np.zeros((48, 64), np.uint8)
    return replace(turn(center), frames=tuple(
        Frame(center + n, n, picture, str(log)) for n in range(images)), prominence=center / 1e3)


@pytest.mark.parametrize('live, done', [
    (False, ['draft of 20', 'draft of 30', 'draft of 10', 'scene of 20', 'scene of 30',
             'scene of 10']),
    (True, ['draft of 30', 'scene of 30', 'draft of 20', 'scene of 20', 'draft of 10',
            'scene of 10'])])
def test_a_turn_is_built_in_two_halves(monkeypatch, tmp_path, live, done):
    """Side by side offline, so that the children end together; one by one live."""
    log, hold = tmp_path / 'log', tmp_path / 'hold'
    use(monkeypatch, child_tasks.build_slowly)
    monkeypatch.setattr(workshop_module, 'build_turn', child_tasks.finish)
    settled = []
    workshop = Workshop(Config().replace({'threads': 1}), queue=9 if live else None,
                        on_built=lambda: settled.append(1))
    try:
        workshop.submit(turn(5, hold), None)
        wait_for((tmp_path / 'hold.5').exists)
        use(monkeypatch, child_tasks.draft)
        for center, images in ((10, 3), (20, 9), (30, 5)):
            workshop.submit(filmed(center, images, log), None)
        workshop.keep_only({10, 20, 30})
        os.kill(int((tmp_path / 'hold.5').read_text()), signal.SIGKILL)
        wait_until_built(workshop)
        # the second half gets the images of the keyframes only
        assert workshop.scenes() == {10: [10, 12], 20: [20, 22, 24, 26, 28], 30: [30, 32, 34]}
        assert log.read_text().split('\n')[-7:-1] == done
        # for each scene, and for the turn that left; not for drafts
        wait_for(lambda: len(settled) == 4)
    finally:
        workshop.close()


def test_a_child_that_dies_in_the_second_half_loses_no_turn(workshop, monkeypatch, tmp_path):
    use(monkeypatch, child_tasks.draft)
    monkeypatch.setattr(workshop_module, 'build_turn', child_tasks.finish_dies_at_first)
    for center in (10, 50, 90):
        workshop.submit(filmed(center, 3, tmp_path / 'log'), None)
    wait_until_built(workshop)
    assert workshop.scenes() == {center: [center, center + 2] for center in (10, 50, 90)}
    # and does not do the first half again
    assert (tmp_path / 'log').read_text().count('draft') == 3


def test_what_failed_is_not_kept_for_a_turn_that_left(workshop, monkeypatch, tmp_path):
    use(monkeypatch, child_tasks.build_fails_at_first)
    workshop.submit(turn(10, tmp_path / 'flag'), None)
    wait_for(lambda: workshop._failed)
    workshop.keep_only(set())
    assert not workshop._failed and workshop.waiting == 0


def test_arrays_travel_beside_the_pickle_and_can_be_written_to(child):
    arrays = [np.arange(6.0).reshape(2, 3), np.zeros((0, 3)), np.arange(9)[::2],
              np.asfortranarray(np.eye(3))]
    for sent, back in zip(arrays, child.call(child_tasks.echo, arrays), strict=True):
        assert np.array_equal(sent, back) and sent.shape == back.shape and back.flags.writeable


def test_the_condition_may_take_a_lock_that_a_submitter_holds(workshop, monkeypatch):
    use(monkeypatch, child_tasks.build)
    lock = threading.Lock()
    asked = threading.Event()

    def ready() -> bool:
        asked.set()
        time.sleep(0.05)
        with lock:
            return workshop.waiting == 0 and 10 in workshop.scenes()

    def submit() -> None:
        assert asked.wait(LIMIT_S)
        with lock:
            time.sleep(0.1)
            workshop.submit(turn(10), None)

    with background(lambda: workshop.wait(ready)) as waited, background(submit) as submitted:
        pass
    assert waited == [None] and submitted == [None]


def test_run_tries_a_child_that_dies_again(workshop, tmp_path):
    assert workshop.run(child_tasks.die_at_first, str(tmp_path / 'flag')) == 'second time'
    with pytest.raises(ChildDiedError, match='exit code 7'):
        workshop.run(child_tasks.die, 7)
    assert workshop.run(child_tasks.add, 1, 2) == 3


def test_close_while_others_wait(workshop, monkeypatch, tmp_path):
    use(monkeypatch, child_tasks.build_slowly)
    flags = [tmp_path / f'flag.{center}' for center in (10, 50)]
    for center in (10, 50, 90):
        workshop.submit(turn(center, tmp_path / 'flag'), None)
    solving = tmp_path / 'solving'
    with (background(lambda: workshop.wait(lambda: False)) as waited,
          background(lambda: workshop.run(child_tasks.sleep, 60, solving)) as ran):
        for flag in (*flags, solving):
            wait_for(lambda flag=flag: flag.exists() and flag.read_text())
        pids = workshop.pids()
        assert len(pids) == 3
        workshop.close()
    assert waited == [None] and isinstance(ran[0], ChildDiedError)
    assert not any(is_running(pid) for pid in pids) and workshop.pids() == []
    # nothing starts again
    workshop.submit(turn(200), None)
    with pytest.raises(ChildDiedError, match='closed'):
        workshop.run(child_tasks.add, 1, 2)
    assert workshop.pids() == []
