"""Signals that come while rclpy starts, when its own handlers are not all there yet."""
from __future__ import annotations

import gc
import sys
import threading
import time

import pytest

pytest.importorskip('rclpy', reason='no ROS on this machine: pip install the ros extra')

import rclpy

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
    with pytest.raises(Exception, match='context'):
        Executor(context=context)
    gc.collect()
    assert told == []
