# SPDX-License-Identifier: Apache-2.0
"""From the command line to a spinning node and back to an exit code."""
from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence

import cv2
import rclpy
import rclpy.utilities
from rclpy.exceptions import InvalidHandle
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from dashcalib_ros.errors import ConfigError
from dashcalib_ros.ros.drive import SetupError
from dashcalib_ros.ros.node import CameraNode
from dashcalib_ros.ros.parameters import given_parameters
from dashcalib_ros.workers.memory import reuse_image_buffers

# s; the wait after a failed callback doubles from the first to the second while all fail
FIRST_WAIT_S, LONGEST_WAIT_S = 0.01, 1.0


def run(program: str, argv: Sequence[str], required: frozenset[str],
        stopped: Callable[[], bool]) -> int:
    """Run a program's node until it is stopped; return 0. Raises DashcalibError.

    argv: ROS's arguments. required: names of parameters that must be known. stopped: returns
    whether a signal stopped it.
    """
    node: CameraNode | None = None
    reuse_image_buffers()
    # detection takes a few ms per image: a second thread costs more than it saves
    cv2.setNumThreads(1)
    try:
        start_ros(program, argv)
        node = CameraNode(program, given_parameters(program), required)
        if node.settings.own.autostart:
            node.start()
        spin(node, stopped)
    finally:
        if node is not None:
            node.close()
        rclpy.utilities.try_shutdown()
    return 0


def start_ros(program: str, argv: Sequence[str]) -> None:
    """Start rclpy; raises ConfigError for arguments and files that it does not understand."""
    try:
        # rclpy takes the program's name for the first argument. Its own handlers of signals would
        # shut it down in the middle of a callback, which then raises nearly anything
        rclpy.init(args=[program, *argv], signal_handler_options=SignalHandlerOptions.NO)
    except (RuntimeError, ValueError) as error:
        # without the lines of rcl's sources
        text = re.sub(r', at [^ ,]*:\d+', '', str(error))
        text = text.removeprefix('failed to initialize rcl: ')
        raise ConfigError('E-ROS-ARGUMENT-INVALID',
                          f'{text}; write remappings as -r FROM:=TO, parameters as '
                          f'-p NAME:=VALUE, files as --params-file FILE') from error


def spin(node: CameraNode, stopped: Callable[[], bool]) -> None:
    """Run the node's callbacks until a signal comes: its next timer ends the wait for others.

    Exceptions of callbacks, and of rclpy itself, are logged and counted, and the node continues.
    Raises SetupError, and exceptions after which rclpy calls no callback any more: the node must
    then be started again, as the launch files do.
    """
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        wait_s = FIRST_WAIT_S
        while not stopped():
            try:
                executor.spin_once()
                wait_s = FIRST_WAIT_S
            except SetupError:
                raise
            except InvalidHandle:
                pass  # an answer of a service that cleanup has taken back
            except Exception as error:
                if node.blocked():
                    raise
                node.survive(error)
                time.sleep(wait_s)
                wait_s = min(2 * wait_s, LONGEST_WAIT_S)
    finally:
        executor.shutdown()
