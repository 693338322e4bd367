# SPDX-License-Identifier: Apache-2.0
"""Engines: every task has one outcome, whatever becomes of the workers."""
from __future__ import annotations

import os
import sys
from pathlib import Path
from types import SimpleNamespace

import fleet_tasks
import pytest
from refused import refused

from dashcalib_ros.errors import ConfigError, InputError, WorkerError
from dashcalib_ros.fleet.engine import DiedError, LocalEngine, RayEngine, Task
from dashcalib_ros.workers.child import ChildWorker


def outcomes_of(engine, tmp_path):
    """Run tasks of every kind; return the outcomes by name."""
    tasks = {'a': (fleet_tasks.double, (1,)), 'b': (fleet_tasks.fail, ('no clip',)),
             'c': (fleet_tasks.break_down, ()),
             'once': (fleet_tasks.die_until, (str(tmp_path / 'once'), 1)),
             'always': (fleet_tasks.die_until, (str(tmp_path / 'always'), 99))}
    for name, (function, arguments) in tasks.items():
        engine.submit(Task(function, arguments, name))
    found = {}
    try:
        for name, outcome in engine.outcomes():
            assert name not in found
            found[name] = outcome
            if name == 'a':
                # a task may follow from an outcome
                engine.submit(Task(fleet_tasks.double, (21,), 'later'), first=True)
    finally:
        engine.close()
    return found


def check(found, tmp_path):
    assert found['a'] == 2 and found['later'] == 42
    assert isinstance(found['b'], InputError)
    assert (found['b'].code, str(found['b'])) == ('E-TRIED', 'no clip')
    assert isinstance(found['c'], WorkerError) and found['c'].code == 'E-UNEXPECTED'
    assert 'ZeroDivisionError' in str(found['c'])
    assert found['once'] == 2
    assert isinstance(found['always'], DiedError) and found['always'].code == 'E-TASK-DIED'
    assert Path(tmp_path / 'always').read_text() == '3'


@pytest.mark.parametrize('count', [1, 3])
def test_child_processes(tmp_path, count):
    engine = LocalEngine(3, [ChildWorker() for _ in range(count)])
    check(outcomes_of(engine, tmp_path), tmp_path)
    assert engine.cpu_s['double'] > 0 and engine.peak_mb > 10


@pytest.mark.thorough
def test_ray(tmp_path, monkeypatch):
    cluster_utils = pytest.importorskip('ray.cluster_utils')
    # as an installed package is there for the cluster's workers
    monkeypatch.setenv('PYTHONPATH', os.pathsep.join(sys.path))
    cluster = cluster_utils.Cluster(initialize_head=True, head_node_args={
        'num_cpus': 2, 'include_dashboard': False})
    try:
        check(outcomes_of(RayEngine(3, 100, cluster.address), tmp_path), tmp_path)
    finally:
        cluster.shutdown()


def ray_that_raises(monkeypatch, error):
    """Return an engine with one task, from whose outcome Ray raises an error of this name."""
    ray = pytest.importorskip('ray')

    def dead(reference):
        raise getattr(ray.exceptions, error)

    remote = SimpleNamespace(remote=lambda *arguments: 'reference')
    for name, value in {
            'init': lambda *where, **options: None,
            'remote': lambda **options: lambda function: remote,
            'cluster_resources': dict, 'wait': lambda found, timeout: (found, []),
            'get': dead}.items():
        monkeypatch.setattr(ray, name, value)
    engine = RayEngine(3, 100, 'auto')
    engine.submit(Task(fleet_tasks.double, (1,), 'a'))
    return engine


def test_ray_that_has_ended_is_one_line(monkeypatch):
    """A killed raylet: Ray raises it from get()."""
    engine = ray_that_raises(monkeypatch, 'LocalRayletDiedError')
    with refused(WorkerError, 'E-RAY-ENDED'):
        list(engine.outcomes())


def test_what_ray_could_not_run_is_the_outcome_of_that_task(monkeypatch):
    engine = ray_that_raises(monkeypatch, 'TaskCancelledError')
    [(about, outcome)] = engine.outcomes()
    assert (about, type(outcome), outcome.code) == ('a', WorkerError, 'E-RAY-TASK-FAILED')


def test_a_cluster_says_which_extra_it_needs(monkeypatch):
    monkeypatch.setitem(sys.modules, 'ray', None)
    with refused(ConfigError, 'E-EXTRA-NOT-INSTALLED', 'ray', '[fleet]'):
        RayEngine(3, 100, 'auto')


def test_no_cluster_is_one_line():
    pytest.importorskip('ray')
    with refused(WorkerError, 'E-RAY-NOT-REACHABLE'):
        RayEngine(3, 100, 'auto')
