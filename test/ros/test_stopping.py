# SPDX-License-Identifier: Apache-2.0
"""How the spinning ends, and that nothing of rclpy but its public interface is used."""
from __future__ import annotations

import ast
import re
import threading
import time

import pytest

pytest.importorskip('rclpy', reason='no ROS on this machine: pip install the ros extra')

import rclpy
from ros_bench import REPOSITORY

from dashcalib_ros.ros.program import spin

ROOM = REPOSITORY / 'dashcalib_ros' / 'ros'


def test_a_signal_ends_the_spinning_and_leaves_rclpy_as_it_was(make_desk):
    desk, stopped = make_desk(), threading.Event()
    desk.spinner.remove_node(desk.node)
    thread = threading.Thread(target=spin, args=(desk.node, stopped.is_set), daemon=True)
    thread.start()
    time.sleep(0.3)
    assert thread.is_alive() and rclpy.ok()
    stopped.set()
    thread.join(10)
    assert not thread.is_alive() and rclpy.ok()


@pytest.mark.parametrize('path', sorted(ROOM.glob('*.py')), ids=lambda path: path.stem)
def test_only_the_public_interface_of_rclpy_is_used(path):
    tree = ast.parse(path.read_text('utf-8'))
    # a class that inherits from rclpy's may have private names of its own, but not read others'
    own = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)
           and isinstance(node.ctx, ast.Store)}
    own |= {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or '').startswith('rclpy'):
            names = [*node.module.split('.'), *(each.name for each in node.names)]
            assert not any(re.match('_|impl$|experimental$', name) for name in names), names
        if isinstance(node, ast.Attribute) and re.match('_[a-z]', node.attr):
            assert node.attr in own, f'{path.name}:{node.lineno}: {node.attr}'
