"""The executor: signals that come while rclpy starts, and what a callback costs."""
from __future__ import annotations

import gc
import sys
import threading
import time

import pytest

pytest.importorskip('rclpy', reason='no ROS on this machine: pip install the ros extra')

import rclpy
from rclpy import executors

from dashcalib_ros.ros.program import Executor, spin


def test_a_signal_that_rclpy_did_not_hear_ends_the_spinning(make_desk):
    desk, stopped = make_desk(), threading.Event()
    desk.spinner.remove_node(desk.node)
    thread = threading.Thread(target=spin, args=(desk.node, stopped.is_set), daemon=True)
    thread.start()
    time.sleep(0.3)
    assert thread.is_alive() and rclpy.ok()
    stopped.set()
    thread.join(10)
    assert not thread.is_alive() and rclpy.ok()


def test_an_executor_that_cannot_be_made_leaves_no_traceback(monkeypatch):
    told = []
    monkeypatch.setattr(sys, 'unraisablehook', told.append)
    context = rclpy.Context()
    # of a context without a handle; Python 3.10 names the method that it has not
    with pytest.raises((AttributeError, TypeError), match=r'context|__enter__'):
        Executor(context=context)
    gc.collect()
    assert told == []


def test_a_callback_costs_one_look_at_the_entities(ros_context, monkeypatch):
    node, called, looks = rclpy.create_node('few', context=ros_context), [], []
    guard = node.create_guard_condition(lambda: called.append(True))
    executor = Executor(context=ros_context)
    executor.add_node(node)
    executor.spin_once(0.1)
    wait_set = executors._rclpy.WaitSet
    monkeypatch.setattr(executors._rclpy, 'WaitSet',
                        lambda *counts: looks.append(True) or wait_set(*counts))
    try:
        for _ in range(3):
            # while it waits, as images do
            threading.Timer(0.1, guard.trigger).start()
            executor.spin_once(5.0)
    finally:
        executor.shutdown()
        node.destroy_node()
    assert len(called) == len(looks) == 3
