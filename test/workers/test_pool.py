# SPDX-License-Identifier: Apache-2.0
"""The pool of workers: every turn once, in order, whatever its worker dies of."""
from __future__ import annotations

import contextlib
import functools
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import child_tasks
import cv2
import numpy as np
import pytest
from waiting import LIMIT_S, background, is_running, wait_for

from dashcalib_ros import reconstruct
from dashcalib_ros.config import Config
from dashcalib_ros.detect.turn import Turn, TurnId
from dashcalib_ros.errors import WorkerError
from dashcalib_ros.input import Frame
from dashcalib_ros.reconstruct import build
from dashcalib_ros.workers import child as child_module
from dashcalib_ros.workers import pool as pool_module
from dashcalib_ros.workers.child import ChildWorker
from dashcalib_ros.workers.pool import ATTEMPTS, ScenePool
from dashcalib_ros.workers.worker import THREAD_VARIABLES, InlineWorker, Worker, WorkerDiedError

at = TurnId.at


@pytest.fixture(autouse=True)
def hurried(monkeypatch) -> None:
    monkeypatch.setattr(pool_module, 'BACK_OFF_S', 0.01)


@pytest.fixture
def trouble() -> list[str]:
    return []


def make_pool(threads: int = 2, make_worker: Callable[[], Worker] = ChildWorker,
              load: Callable[[], object] = child_tasks.pid, **options: Any) -> ScenePool:
    """Make a pool whose workers load nothing large."""
    return ScenePool(Config().replace({'workers': threads}), make_worker, load, **options)


@pytest.fixture
def pool(trouble) -> Iterator[ScenePool]:
    pool = make_pool(2, on_trouble=trouble.append)
    yield pool
    pool.close()


def turn(center: int, note: Path | str = '') -> Turn:
    return Turn(center, center - 5, center + 5, center / 10, 0.05, (str(note),))


def wait_until_built(pool: ScenePool) -> None:
    end = time.monotonic() + LIMIT_S
    pool.wait(lambda: len(pool.unbuilt()) == 0 or time.monotonic() > end)
    assert len(pool.unbuilt()) == 0, 'waited in vain'


def use(monkeypatch, function: Callable[..., object]) -> None:
    """Have turns that are submitted from now on drafted so."""
    monkeypatch.setattr(reconstruct, 'draft', function)


def waiting(pool: ScenePool) -> list[TurnId | None]:
    """Return the turns whose calls no worker has now; None for each other call."""
    return [call.turn and call.turn.id for call in pool._calls if not call.running]


def test_turns_become_scenes_once(pool, monkeypatch):
    use(monkeypatch, child_tasks.build)
    for center in (10, 50, 90, 50):
        pool.submit(turn(center), None)
    wait_until_built(pool)
    assert pool.scenes() == {at(center): f'scene of {center}' for center in (10, 50, 90)}
    assert all(child.pid is not None for child in pool._workers)


@pytest.mark.parametrize('error', [cv2.error('remap: dst is empty'),
                                   np.linalg.LinAlgError('Singular matrix')])
def test_a_hopeless_turn_has_no_scene_and_verbose_tells_why(monkeypatch, capsys, error):
    def fail(*arguments: object) -> None:
        raise error

    monkeypatch.setattr(build, 'draft_scene', fail)
    assert reconstruct.draft(turn(10), Config(), None) is None
    # a child's stderr is the terminal with --verbose, and nowhere else
    told = capsys.readouterr().err
    assert 'turn at frame 10' in told and str(error) in told


def test_without_a_queue_the_longest_is_built_first(monkeypatch, tmp_path):
    use(monkeypatch, child_tasks.build_slowly)
    pool = make_pool(1)
    try:
        pool.submit(turn(10, tmp_path / 'flag'), None)
        wait_for((tmp_path / 'flag.10').exists)
        use(monkeypatch, child_tasks.build)
        for center, images in ((20, 2), (30, 9), (40, 5)):
            pool.submit(replace(turn(center), frames=('',) * images, prominence=1 / center),
                            None)
        pool.keep_only({at(20), at(30), at(40)})
        os.kill(int((tmp_path / 'flag.10').read_text()), signal.SIGKILL)
        wait_until_built(pool)
        assert list(pool.scenes()) == [at(30), at(40), at(20)]
    finally:
        pool.close()


def test_a_child_that_dies_loses_no_turn(pool, monkeypatch, tmp_path):
    use(monkeypatch, child_tasks.build_dies_at_first)
    for center in (10, 50, 90):
        pool.submit(turn(center, tmp_path / 'flag'), None)
    wait_until_built(pool)
    assert pool.scenes() == dict.fromkeys((at(10), at(50), at(90)), 'second time')


def test_a_turn_whose_child_is_killed_from_outside_is_built_again(
        pool, monkeypatch, tmp_path):
    use(monkeypatch, child_tasks.build_hangs_at_first)
    flag = tmp_path / 'flag.10'
    pool.submit(turn(10, tmp_path / 'flag'), None)
    wait_for(lambda: flag.exists() and flag.read_text())
    os.kill(int(flag.read_text()), signal.SIGKILL)
    wait_until_built(pool)
    assert pool.scenes() == {at(10): 'scene of 10'}


def test_a_turn_that_kills_every_child_is_given_up_and_told(monkeypatch, tmp_path):
    log, told = tmp_path / 'log', []
    use(monkeypatch, child_tasks.build_dies)
    pool = make_pool(on_trouble=told.append)
    pool.submit(turn(10, log), None)
    wait_until_built(pool)
    assert pool.scenes() == {at(10): None}
    assert [each.code for each in pool.lost] == ['E-TURN-LEFT-OUT']
    assert told[-1] == str(pool.lost[0])
    assert 'turn at frame 10' in told[-1]
    assert log.read_text() == '10\n' * ATTEMPTS
    # the others still are built
    use(monkeypatch, child_tasks.build)
    pool.submit(turn(50), None)
    wait_until_built(pool)
    assert pool.scenes() == {at(10): None, at(50): 'scene of 50'} and len(pool.lost) == 1
    pool.close()


def test_where_no_child_can_live_the_pictures_are_not_blamed(pool, monkeypatch):
    """A broken installation, say, or a library of another processor."""
    monkeypatch.setattr(pool_module, 'ATTEMPTS', 2)
    use(monkeypatch, child_tasks.build)
    with monkeypatch.context() as broken:
        broken.setattr(child_module, 'START', 'import sys; sys.exit(7)')
        with pytest.raises(WorkerError, match='exit code 7') as caught:
            pool.run(child_tasks.add, 1, 2)
        assert caught.value.code == 'E-WORKER-CANNOT-LOAD'
        pool.submit(turn(10), None)
        with pytest.raises(WorkerError, match='exit code 7') as caught:
            wait_until_built(pool)
        assert caught.value.code == 'E-WORKER-CANNOT-LOAD'
    wait_until_built(pool)
    assert pool.scenes() == {at(10): 'scene of 10'} and pool.run(child_tasks.add, 1, 2) == 3


def test_an_error_is_told_once_and_the_turn_tried_again(pool, monkeypatch, tmp_path):
    use(monkeypatch, child_tasks.build_fails_at_first)
    pool.submit(turn(10, tmp_path / 'flag'), None)
    with pytest.raises(WorkerError, match=r'frame 10 .*MemoryError: no room') as caught:
        wait_until_built(pool)
    assert caught.value.code == 'E-TURN-FAILED'
    assert len(pool.unbuilt()) == 1
    wait_until_built(pool)
    assert pool.scenes() == {at(10): 'scene of 10'}


def test_scenes_of_turns_that_left_are_dropped(pool, monkeypatch, tmp_path):
    use(monkeypatch, child_tasks.build)
    for center in (10, 50):
        pool.submit(turn(center), None)
    wait_until_built(pool)
    pool.keep_only({at(50)})
    assert pool.scenes() == {at(50): 'scene of 50'}
    # also one that is not built yet
    use(monkeypatch, child_tasks.build_slowly)
    pool.submit(turn(90, tmp_path / 'flag'), None)
    wait_for((tmp_path / 'flag.90').exists)
    pool.keep_only({at(50)})
    assert len(pool.unbuilt()) == 0


def test_the_most_prominent_is_built_first_and_the_queue_has_an_end(monkeypatch, tmp_path):
    use(monkeypatch, child_tasks.build_slowly)
    pool = make_pool(1, queue=2)
    try:
        pool.submit(turn(10, tmp_path / 'flag'), None)
        wait_for((tmp_path / 'flag.10').exists)
        use(monkeypatch, child_tasks.build)
        for center, prominence in ((20, 0.02), (30, 0.03), (40, 0.01), (50, 0.04)):
            pool.submit(replace(turn(center), prominence=prominence), None)
        # one is being built, two wait with their images
        assert set(waiting(pool)) == {at(30), at(50)}
        assert pool.unbuilt() == {at(10), at(30), at(50)}
        assert pool.scenes() == {at(20): None, at(40): None}
        pool.keep_only({at(20), at(30), at(40), at(50)})
        os.kill(int((tmp_path / 'flag.10').read_text()), signal.SIGKILL)
        wait_until_built(pool)
        assert list(pool.scenes().items())[2:] == [
            (at(50), 'scene of 50'), (at(30), 'scene of 30')]
        pool.submit(turn(60), None)
        pool.keep_only(set())
        assert not pool._calls and len(pool.unbuilt()) == 0
    finally:
        pool.close()


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
    monkeypatch.setattr(reconstruct, 'finish', child_tasks.finish)
    pool = make_pool(1, queue=9 if live else None)
    try:
        pool.submit(turn(5, hold), None)
        wait_for(lambda: (tmp_path / 'hold.5').exists() and (tmp_path / 'hold.5').read_text())
        use(monkeypatch, child_tasks.draft)
        for center, images in ((10, 3), (20, 9), (30, 5)):
            pool.submit(filmed(center, images, log), None)
        pool.keep_only({at(10), at(20), at(30)})
        os.kill(int((tmp_path / 'hold.5').read_text()), signal.SIGKILL)
        wait_until_built(pool)
        # the second half gets the images of the keyframes only
        assert pool.scenes() == {
            at(10): [10, 12], at(20): [20, 22, 24, 26, 28], at(30): [30, 32, 34]}
        assert log.read_text().split('\n')[-7:-1] == done
    finally:
        pool.close()


def test_a_child_that_dies_in_the_second_half_loses_no_turn(pool, monkeypatch, tmp_path):
    use(monkeypatch, child_tasks.draft)
    monkeypatch.setattr(reconstruct, 'finish', child_tasks.finish_dies_at_first)
    for center in (10, 50, 90):
        pool.submit(filmed(center, 3, tmp_path / 'log'), None)
    wait_until_built(pool)
    assert pool.scenes() == {at(center): [center, center + 2] for center in (10, 50, 90)}
    # and does not do the first half again
    assert (tmp_path / 'log').read_text().count('draft') == 3


def test_what_failed_is_not_kept_for_a_turn_that_left(pool, monkeypatch, tmp_path):
    monkeypatch.setattr(pool_module, 'BACK_OFF_S', 1000.0)
    use(monkeypatch, child_tasks.build_fails_at_first)
    pool.submit(turn(10, tmp_path / 'flag'), None)
    wait_for(lambda: waiting(pool) == [at(10)] and pool._calls[0].error is not None)
    pool.keep_only(set())
    assert not pool._calls and not pool.unbuilt()
    pool.wait(lambda: True)


def test_a_lost_turn_is_tried_again_by_itself(pool, trouble, monkeypatch, tmp_path):
    """Killed at each start for a while and then left alone; nobody waits for it."""
    use(monkeypatch, child_tasks.build_dies)
    pool._load = child_tasks.die
    pool.submit(turn(10, tmp_path / 'log'), None)
    wait_for(lambda: len(trouble) > ATTEMPTS)
    (tmp_path / 'log.ended').touch()
    assert all('exit code 1' in line and 'turn at frame 10 is tried again' in line
               and '\n' not in line for line in trouble)
    assert sum('no reconstruction process can start' in line for line in trouble) == 1
    wait_for(lambda: pool.scenes() == {at(10): 'scene of 10'})
    # what is over is not told to who waits now
    pool.wait(lambda: True)


def test_a_turn_that_raised_is_tried_again_by_itself(pool, trouble, monkeypatch, tmp_path):
    use(monkeypatch, child_tasks.build_fails_at_first)
    pool.submit(turn(10, tmp_path / 'flag'), None)
    wait_for(lambda: pool.scenes() == {at(10): 'scene of 10'})
    assert len(trouble) == 1 and 'MemoryError: no room' in trouble[0]


def test_a_hung_child_is_told_of_and_its_turn_tried_again(pool, trouble, monkeypatch, tmp_path):
    monkeypatch.setattr(child_module, 'LOOKS_TO_REPORT', 1)
    monkeypatch.setattr(child_module, 'LOOKS_TO_KILL', 2)
    use(monkeypatch, child_tasks.build_hangs_at_first)
    pool.submit(turn(10, tmp_path / 'flag'), None)
    wait_for(lambda: pool.scenes() == {at(10): 'scene of 10'})
    assert any('turn at frame 10 is tried again' in line for line in trouble)


def test_the_pauses_grow_and_have_an_end(monkeypatch):
    monkeypatch.setattr(pool_module, 'BACK_OFF_S', 1.0)
    assert [pool_module.back_off_s(n) for n in (1, 2, 3, 4, 100, 2000)] == [1, 2, 4, 8, 60, 60]


def test_a_turn_that_failed_waits_while_others_do_not(monkeypatch, tmp_path):
    monkeypatch.setattr(pool_module, 'BACK_OFF_S', 1000.0)
    monkeypatch.setattr(pool_module, 'LONGEST_BACK_OFF_S', 1000.0)
    use(monkeypatch, child_tasks.build_fails_at_first)
    pool = make_pool(1)
    with contextlib.closing(pool):
        pool.submit(turn(10, tmp_path / 'flag'), None)
        wait_for(lambda: waiting(pool) == [at(10)] and pool._calls[0].failures)
        use(monkeypatch, child_tasks.build)
        pool.submit(turn(20), None)
        wait_for(lambda: pool.scenes() == {at(20): 'scene of 20'})
        assert pool.unbuilt() == {at(10)} and 900.0 < pool._pause_s() <= 1000.0


def test_who_runs_something_comes_before_the_turns(monkeypatch, tmp_path):
    use(monkeypatch, child_tasks.build_slowly)
    pool = make_pool(1)
    try:
        pool.submit(turn(10, tmp_path / 'flag'), None)
        wait_for(lambda: (tmp_path / 'flag.10').exists())
        pool.submit(turn(20, tmp_path / 'flag'), None)
        with background(lambda: pool.run(os.path.exists, tmp_path / 'flag.20')) as ran:
            wait_for(lambda: None in waiting(pool))
            pool.keep_only({at(20)})
            pool._workers[0].kill()
        assert ran == [False]
        wait_for((tmp_path / 'flag.20').exists)
    finally:
        pool.close()


def test_inline_it_is_all_the_same(monkeypatch):
    for name in THREAD_VARIABLES:
        monkeypatch.setenv(name, '1')
    use(monkeypatch, child_tasks.build)
    pool = make_pool(2, InlineWorker)
    for center in (10, 50, 90):
        pool.submit(turn(center), None)
    wait_until_built(pool)
    assert pool.scenes() == {at(center): f'scene of {center}' for center in (10, 50, 90)}
    assert pool.run(child_tasks.pid) == os.getpid() and pool.pids() == []
    pool.close()
    with pytest.raises(WorkerDiedError) as caught:
        pool.run(child_tasks.pid)
    assert caught.value.code == 'E-CALIBRATOR-CLOSED'


@pytest.mark.parametrize('kept', [True, False])
def test_pictures_are_kept_where_they_are_wanted_and_leave_with_their_turns(monkeypatch, kept):
    for name in THREAD_VARIABLES:
        monkeypatch.setenv(name, '1')
    use(monkeypatch, lambda turn, config, valid: None)
    pool = make_pool(2, InlineWorker, keep_pictures=kept)
    with contextlib.closing(pool):
        for center in (10, 50):
            pool.submit(replace(turn(center), frames=(
                Frame(center, 0, np.zeros((4, 6), np.uint8)),)), None)
        wait_until_built(pool)
        assert {key: picture.frame for key, picture in pool.pictures().items()} == (
            {at(10): 10, at(50): 50} if kept else {})
        pool.keep_only({at(50)})
        assert set(pool.pictures()) == ({at(50)} if kept else set())


def test_the_condition_may_take_a_lock_that_a_submitter_holds(pool, monkeypatch):
    use(monkeypatch, child_tasks.build)
    lock = threading.Lock()
    asked = threading.Event()

    def ready() -> bool:
        asked.set()
        time.sleep(0.05)
        with lock:
            return len(pool.unbuilt()) == 0 and at(10) in pool.scenes()

    def submit() -> None:
        assert asked.wait(LIMIT_S)
        with lock:
            time.sleep(0.1)
            pool.submit(turn(10), None)

    with background(lambda: pool.wait(ready)) as waited, background(submit) as submitted:
        pass
    assert waited == [None] and submitted == [None]


def test_who_waits_may_do_other_things_meanwhile(monkeypatch, tmp_path):
    use(monkeypatch, child_tasks.build)
    done: list[str] = []

    def meanwhile() -> bool:
        if done:
            return False
        done.append(threading.current_thread().name)
        pool.submit(turn(10), None)
        return True

    pool = make_pool(1, on_wait=meanwhile)
    with contextlib.closing(pool):
        assert pool.run(child_tasks.add, 1, 2) == 3
        wait_until_built(pool)
    assert done == [threading.current_thread().name]
    assert pool.scenes() == {at(10): 'scene of 10'}


def test_run_tries_a_child_that_dies_again(pool, tmp_path):
    assert pool.run(child_tasks.die_at_first, str(tmp_path / 'flag')) == 'second time'
    with pytest.raises(WorkerDiedError, match='exit code 7') as caught:
        pool.run(child_tasks.die, 7)
    assert caught.value.code == 'E-WORKER-DIED'
    assert pool.run(child_tasks.add, 1, 2) == 3


def test_what_was_begun_runs_side_by_side_and_what_waits_can_be_dropped(pool, tmp_path):
    started = [tmp_path / name for name in ('first', 'second')]
    begun = [pool.begin(child_tasks.until, tmp_path / 'go', path) for path in started]
    wait_for(lambda: all(path.exists() and path.read_text() for path in started))
    assert started[0].read_text() != started[1].read_text()
    dropped = pool.begin(Path.touch, tmp_path / 'dropped')
    pool.drop(dropped)
    (tmp_path / 'go').touch()
    assert [pool.result(call) for call in begun] == ['seen', 'seen']
    told = []
    assert pool.result(pool.begin(child_tasks.count, 2, reports=True),
                       lambda stage, done: told.append(stage)) == 2
    assert told == ['step 0', 'step 1'] and not dropped.done
    assert not (tmp_path / 'dropped').exists()


def test_a_child_that_dies_before_its_first_call_is_not_missed(trouble, tmp_path):
    pool = make_pool(1, load=child_tasks.die, on_trouble=trouble.append)
    with contextlib.closing(pool):
        pool.start()
        assert pool.run(child_tasks.add, 1, 2) == 3 and not trouble


def test_each_worker_begins_with_what_it_needs(tmp_path):
    pool = make_pool(2, load=functools.partial(child_tasks.sleep, 0, tmp_path / 'loaded'))
    with contextlib.closing(pool):
        assert not pool.pids()
        pool.start()
        wait_for((tmp_path / 'loaded').exists)
        wait_for(lambda: len(pool.pids()) == 2)
        threads = list(pool._threads)
        pool.start()
        assert pool.run(child_tasks.add, 1, 2) == 3 and pool._threads == threads


def test_what_was_dropped_is_not_tried_again(pool, trouble, tmp_path):
    started = tmp_path / 'started'
    call = pool.begin(child_tasks.sleep, 60, started)
    wait_for(lambda: started.exists() and started.read_text())
    pool.drop(call)
    os.kill(int(started.read_text()), signal.SIGKILL)
    # both workers are free again
    go, paths = tmp_path / 'go', [tmp_path / name for name in ('first', 'second')]
    begun = [pool.begin(child_tasks.until, go, path) for path in paths]
    wait_for(lambda: all(path.exists() for path in paths))
    go.touch()
    assert [pool.result(each) for each in begun] == ['seen', 'seen']
    assert not trouble and not call.done


def test_close_while_others_wait(pool, monkeypatch, tmp_path):
    use(monkeypatch, child_tasks.build_slowly)
    solving, flag = tmp_path / 'solving', tmp_path / 'flag.10'
    with (background(lambda: pool.wait(lambda: False)) as waited,
          background(lambda: pool.run(child_tasks.sleep, 60, solving)) as ran,
          contextlib.ExitStack() as stack):
        wait_for(lambda: solving.exists() and solving.read_text())
        for center in (10, 50):
            pool.submit(turn(center, tmp_path / 'flag'), None)
        wait_for(lambda: flag.exists() and flag.read_text())
        # all workers are busy
        queued = stack.enter_context(background(lambda: pool.run(child_tasks.add, 1, 2)))
        wait_for(lambda: waiting(pool).count(None))
        pids = pool.pids()
        assert len(pids) == 2
        pool.close()
    assert waited == [None]
    assert isinstance(ran[0], WorkerDiedError) and isinstance(queued[0], WorkerDiedError)
    assert not any(is_running(pid) for pid in pids) and pool.pids() == []
    # nothing starts again
    pool.submit(turn(200), None)
    with pytest.raises(WorkerDiedError) as caught:
        pool.run(child_tasks.add, 1, 2)
    assert caught.value.code == 'E-CALIBRATOR-CLOSED'
    assert pool.pids() == []
