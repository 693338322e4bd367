"""From the command line to a spinning node and back to an exit code."""
from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import rclpy
import rclpy.utilities
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.task import Task

from dashcalib_ros.errors import ConfigError
from dashcalib_ros.ros.calibrator_node import CalibratorNode
from dashcalib_ros.ros.check_node import CheckNode
from dashcalib_ros.ros.node import CameraNode, SetupError
from dashcalib_ros.workers.memory import reuse_image_buffers

# s; the wait after a failed callback doubles from the first to the second while all fail
FIRST_WAIT_S, LONGEST_WAIT_S = 0.01, 1.0


def run(argv: Sequence[str], lifecycle: bool, stopped: Callable[[], bool]) -> int:
    """Run the node until it is stopped; return 0. Raises DashcalibError.

    argv: ROS's arguments. lifecycle: it waits for configure and activate. stopped: returns whether
    a signal stopped it.
    """
    node: CameraNode | None = None
    reuse_image_buffers()
    # detection takes a few ms per image: a second thread costs more than it saves
    cv2.setNumThreads(1)
    try:
        start_ros(argv)
        if not stopped():
            node = make_node(lifecycle)
            spin(node, stopped)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except Exception as error:
        # a context that is shut down in the middle of a call makes rclpy raise nearly anything,
        # which may look like a wrong parameter
        if not stopped():
            if isinstance(error, ParameterException):
                raise ConfigError('E-PARAMETER-VALUE-INVALID', str(error)) from error
            raise
    finally:
        if node is not None:
            node.close()
        rclpy.utilities.try_shutdown()
    return 0


class Managed(LifecycleNodeMixin, CameraNode):  # type: ignore[misc]
    """A node with a lifecycle. What it learned outlives deactivate; cleanup drops it.

    Images are subscribed, and camera_info is published beside them, only while it is active. The
    kept calibration stays latched on ~/calibration in every state.
    """

    def __init__(self) -> None:
        CameraNode.__init__(self, listen=False)
        LifecycleNodeMixin.__init__(self)
        self.answer_always()

    def _answering(self, callback: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        def answer(request: Any, response: Any) -> Any:
            try:
                return callback(request, response)
            except RuntimeError:
                # of rcl, which says in one line that there is no such transition
                if not isinstance(request, ChangeState.Request):
                    raise
                return response
        return super()._answering(answer)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe the images."""
        self._images.start()
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop listening; turns and calibration stay."""
        self._images.stop()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin anew: with the kept calibration and without turns."""
        self.begin_anew()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop listening for good."""
        self._images.stop()
        return super().on_shutdown(state)


class ManagedCalibratorNode(Managed, CalibratorNode):
    """A managed node that calibrates."""


class ManagedCheckNode(Managed, CheckNode):
    """A managed node that checks."""


def make_node(lifecycle: bool) -> CameraNode:
    """Make the node that the parameters describe."""
    # a parameter decides which node is to be made, and only a node knows its parameters
    probe = Node('calibrator', enable_rosout=False, start_parameter_services=False)
    any_type = ParameterDescriptor(dynamic_typing=True)
    check_only = probe.declare_parameter('check_only', False, any_type).value is True
    probe.destroy_node()
    if lifecycle:
        return ManagedCheckNode() if check_only else ManagedCalibratorNode()
    return CheckNode() if check_only else CalibratorNode()


def start_ros(argv: Sequence[str]) -> None:
    """Start rclpy; raises ConfigError for arguments and files that it does not understand."""
    try:
        # rclpy takes the program's name for the first argument
        rclpy.init(args=['calibrator', *argv])
    except (RuntimeError, ValueError) as error:
        # without the lines of rcl's sources
        text = re.sub(r', at [^ ,]*:\d+', '', str(error))
        text = text.removeprefix('failed to initialize rcl: ')
        raise ConfigError('E-ROS-ARGUMENT-INVALID',
                          f'{text}; write remappings as -r FROM:=TO, parameters as '
                          f'-p NAME:=VALUE, files as --params-file FILE') from error


class Executor(SingleThreadedExecutor):
    """rclpy's, but for two things.

    It prints no traceback where the context is shut down already. It does not wake itself after
    each callback: that made it gather all entities of the node twice, and in one thread nothing
    waits meanwhile.
    """

    # its __del__ reads this, also where __init__ failed before setting it
    _sigint_gc: Any = None
    _guard: Any

    def _make_handler(self, *arguments: Any) -> Task:
        guard, self._guard = self._guard, _Silent()
        try:
            return super()._make_handler(*arguments)
        finally:
            self._guard = guard


class _Silent:
    """A guard condition that wakes nothing."""

    def trigger(self) -> None:
        """Do nothing."""


def spin(node: CameraNode, stopped: Callable[[], bool]) -> None:
    """Run the node's callbacks until the context is shut down, or a signal comes.

    A signal that comes while rclpy installs its own handlers does not shut the context down; the
    next timer of the node then ends the wait.

    Exceptions of callbacks, and of rclpy itself, are logged and counted, and the node continues.
    Raises SetupError, and exceptions after which rclpy calls no callback any more: the node must
    then be started again, as the launch files do.
    """
    with Executor() as executor:
        executor.add_node(node)
        wait_s = FIRST_WAIT_S
        while executor.context.ok() and not stopped():
            try:
                executor.spin_once()
                wait_s = FIRST_WAIT_S
            except (SetupError, ExternalShutdownException):
                raise
            except Exception as error:
                if not executor.context.ok():
                    return  # shut down by a signal in the middle of a call, which raises anything
                if node.blocked():
                    raise
                node.survive(error)
                time.sleep(wait_s)
                wait_s = min(2 * wait_s, LONGEST_WAIT_S)
