# SPDX-License-Identifier: Apache-2.0
"""The node: its parameters, its lifecycle, and what answers where a callback fails."""
from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter

from dashcalib_ros.errors import ConfigError, DashcalibError, coded
from dashcalib_ros.formats.ros import check_camera_name
from dashcalib_ros.ros.calibrate import Calibrating
from dashcalib_ros.ros.check import Checking
from dashcalib_ros.ros.diagnostics import Complaints, Log
from dashcalib_ros.ros.endpoints import Endpoints
from dashcalib_ros.ros.interface import CALIBRATOR, CHECKER, RIG
from dashcalib_ros.ros.parameters import (
    camera_name,
    changed,
    check_changeable,
    declare,
    refusal,
    unknown_text,
)
from dashcalib_ros.ros.place import Placing

# s between two looks at the publishers of images; a signal that ends the node waits no longer
LOOK_S = 0.25
ROLES: dict[str, type[Calibrating] | type[Checking] | type[Placing]] = {
    CALIBRATOR: Calibrating, CHECKER: Checking, RIG: Placing}


class CameraNode(LifecycleNode):  # type: ignore[misc]
    """A program of this package as a node with a lifecycle.

    configure makes all that learns, publishes and keeps the file; images are subscribed, and
    camera_info is published beside them, while it is active. Turns and calibration outlive
    deactivate; cleanup, shutdown and an error leave no thread, child process or lock behind.

    role: what the program does, None while it is not configured. settings: of the parameters.
    """

    def __init__(self, program: str, given: Mapping[str, Any],
                 required: frozenset[str] = frozenset()) -> None:
        """program: of PROGRAMS. given: the parameters that were given at the start.

        required: names of those that must be known; others of given that are not are for other
        nodes. Raises ConfigError for wrong parameters.
        """
        super().__init__(program)
        try:
            self._program, self._given, self._required = program, given, required
            self._log = Log(self)
            self.complaints = Complaints(self._log.warning)
            self.role: Calibrating | Checking | Placing | None = None
            self._endpoints: Endpoints | None = None
            # why it could not be configured
            self._failure: Exception | None = None
            self._starting = False
            self.settings = declare(self, program, given)
            self.create_timer(LOOK_S, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME))
            # those of rclpy itself, which has no other way: where a callback raises, the client
            # waits for ever (rclcpp issue 1581, of both libraries), and up to Jazzy rclpy raises
            # for a transition that there is not (rclpy issue 1209)
            for service in self.services:
                service.callback = self._answering(service.callback)
            self.add_on_set_parameters_callback(self._on_parameters)
        except Exception:
            # a node that is left half made may crash rclpy at the end of the process
            self.destroy_node()
            raise

    def start(self) -> None:
        """Configure and activate it; raises what keeps it from that."""
        self._starting = True
        try:
            for trigger in (self.trigger_configure, self.trigger_activate):
                if trigger() != TransitionCallbackReturn.SUCCESS and self._failure is not None:
                    raise self._failure
        finally:
            self._starting = False

    def close(self) -> None:
        """End all threads and child processes, then the node."""
        self._release()
        self.destroy_node()

    # transitions -------------------------------------------------------------------------------

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Make all that the program needs; fails, with a line, for settings that do not work."""
        self._failure = None
        try:
            self._configure()
        except DashcalibError as error:
            self._release()
            self._failure = error
            if not self._starting:
                self._log.error(coded(error))
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            self._failure = error
            if not self._starting:
                self.complaints.failure('failed_callbacks', error)
            return TransitionCallbackReturn.ERROR
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let the publishers speak, and subscribe the images."""
        assert self.role is not None and self._endpoints is not None
        result = super().on_activate(state)
        self._endpoints.activate()
        self.role.inputs.start()
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop listening; turns and calibration stay."""
        assert self.role is not None
        self.role.inputs.stop()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Free all that configure made."""
        self._release()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Free all that configure made, for good."""
        self._release()
        return super().on_shutdown(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Free all that configure made: it may be configured again."""
        self._release()
        return super().on_error(state)

    def _configure(self) -> None:
        self.complaints = Complaints(self._log.warning)
        self._endpoints = endpoints = Endpoints(self, self._log, self.complaints, self._given)
        name = camera_name(self.settings.own, self.resolve_topic_name('image_raw'))
        check_camera_name(name)
        self.role = ROLES[self._program](endpoints, self.settings, name)
        # all parameters are declared now, those of qos_overrides too
        known = self.role.inputs.override_names
        if text := unknown_text(self, self._program, self._required - known):
            raise ConfigError('E-PARAMETER-UNKNOWN', text)
        if text := unknown_text(self, self._program, self._given.keys() - known):
            self._log.warning(f'{text}: left alone, as it may be of another node')
        self._log.info(self.role.summary)

    def _release(self) -> None:
        endpoints, self._endpoints, self.role = self._endpoints, None, None
        if endpoints is not None:
            endpoints.close()

    # callbacks ---------------------------------------------------------------------------------

    def _look(self) -> None:
        if self.role is not None:
            self.role.inputs.look()

    def survive(self, error: Exception) -> None:
        """Log and count what a callback raised."""
        self.complaints.failure('failed_callbacks', error)

    def blocked(self) -> bool:
        """Return whether rclpy calls no callback any more, after an exception of its own."""
        return not all(timer.callback_group.can_execute(timer) for timer in self.timers)

    def _answering(self, callback: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """Return a callback that answers where another fails: its client would wait for ever."""
        def answer(request: Any, response: Any) -> Any:
            try:
                return callback(request, response)
            except Exception as error:
                # of rcl, which says in one line that there is no such transition
                if not (isinstance(request, ChangeState.Request)
                        and isinstance(error, RuntimeError)):
                    self.survive(error)
                return refusal(request, response, f'failed: {coded(error)}; see the log of the '
                                                  f'node')
        return answer

    # parameters --------------------------------------------------------------------------------

    def _on_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        before = self.settings.core.turns
        try:
            # so many turns are kept: no more can be wanted later
            settings = changed(self.settings, parameters, max(before.capacity, before.wanted))
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=coded(error))
        self.settings = settings
        wanted = settings.core.turns.wanted
        if wanted != before.wanted:
            self._log.info(f'turns.wanted is now {wanted}, it was {before.wanted}')
        if self.role is not None:
            self.role.change(settings)
        return SetParametersResult(successful=True)

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set parameters as rclpy does; refuse unknown and read-only ones with the remedy.

        rclpy refuses these without saying what to do, before it asks the callback that may give a
        reason; the one that it asks earlier may give none (rclcpp pull request 1947 has both).
        """
        try:
            check_changeable(self, self._program, (each.name for each in parameter_list))
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=coded(error))
        return super().set_parameters_atomically(parameter_list)
