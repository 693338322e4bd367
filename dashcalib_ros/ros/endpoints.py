# SPDX-License-Identifier: Apache-2.0
"""Makes what a configured node has in ROS, and takes all of it back."""
from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from importlib import import_module
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.guard_condition import GuardCondition
from rclpy.lifecycle import LifecycleNode
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.task import Future
from std_srvs.srv import Trigger

from dashcalib_ros.errors import coded
from dashcalib_ros.ros.diagnostics import Complaints, Log
from dashcalib_ros.ros.interface import PUBLISHED, SUBSCRIBED, Topic

# success and a message
Answer = tuple[bool, str]
# history, depth and reliability; not durability, as a latched topic that is not latched would
# break its readers
OVERRIDES = QoSOverridingOptions.with_default_policies()


def profile(topic: Topic) -> QoSProfile:
    """Return a topic's QoS; a new object, as rclpy writes overrides into it."""
    return QoSProfile(
        depth=topic.depth,
        reliability=(ReliabilityPolicy.RELIABLE if topic.reliable
                     else ReliabilityPolicy.BEST_EFFORT),
        durability=(DurabilityPolicy.TRANSIENT_LOCAL if topic.latched
                    else DurabilityPolicy.VOLATILE))


class Endpoints:
    """A node's publishers, subscriptions, services and timers from on_configure to on_cleanup.

    node: for questions about names, the graph and the time. given: the parameters that were given
    at the start. All entities can have their QoS overridden.
    """

    def __init__(self, node: LifecycleNode, log: Log, complaints: Complaints,
                 given: Mapping[str, Any]) -> None:
        self.node, self.log, self.complaints, self.given = node, log, complaints, given
        # not the ROS clock: timers must also run while a simulation is paused
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._ends = ExitStack()
        # by the name of the latched topic
        self._latest: dict[str, tuple[Publisher, Any]] = {}

    def publisher(self, name: str) -> Publisher:
        """Make the publisher of a topic of PUBLISHED; silent while the node is inactive.

        Raises ImportError where the package of its messages is missing.
        """
        about = PUBLISHED[name]
        make, destroy = (
            (self.node.create_publisher, self.node.destroy_publisher) if about.always else
            (self.node.create_lifecycle_publisher, self.node.destroy_lifecycle_publisher))
        made: Publisher = make(message_class(about.type), name, profile(about),
                               qos_overriding_options=OVERRIDES)
        self.at_end(destroy, made)
        return made

    def latched(self, name: str) -> Callable[[Any], None]:
        """Make the publisher of a latched topic; return what publishes a message on it.

        The last one is published again when the node is activated. Raises as publisher().
        """
        publisher = self.publisher(name)

        def publish(message: Any) -> None:
            self._latest[name] = publisher, message
            publisher.publish(message)
        return publish

    def activate(self) -> None:
        """Publish what is latched: nobody has heard it while the node was inactive."""
        for publisher, message in self._latest.values():
            publisher.publish(message)

    def subscription(self, name: str, callback: Callable[[Any], None], topic: str = ''
                     ) -> Subscription:
        """Make the subscription of a topic of SUBSCRIBED; topic: its name, if it is another."""
        about = SUBSCRIBED[name]
        made = self.node.create_subscription(
            message_class(about.type), topic or name, callback, profile(about),
            qos_overriding_options=OVERRIDES)
        self.at_end(self.node.destroy_subscription, made)
        return made

    def service(self, name: str, action: Callable[[], Answer | Future]) -> None:
        """Offer a service; action: returns success and a message, or what will have them."""
        async def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            try:
                found = action()
                response.success, response.message = (
                    await found if isinstance(found, Future) else found)
            except Exception as error:  # a client waits for ever for an answer that does not come
                self.complaints.failure('failed_callbacks', error)
                response.success = False
                response.message = f'failed: {coded(error)}; see the log of the node'
            return response
        # of a group of its own: nothing else waits for an answer that takes its time
        self.at_end(self.node.destroy_service, self.node.create_service(
            Trigger, name, answer, callback_group=ReentrantCallbackGroup()))

    def timer(self, period_s: float, callback: Callable[[], None]) -> Callable[[], object]:
        """Call back again and again; return what ends that."""
        made = self.node.create_timer(period_s, callback, clock=self._steady)
        self.at_end(self.node.destroy_timer, made)
        return lambda: self.node.destroy_timer(made)

    def guard_condition(self, callback: Callable[[], None]) -> GuardCondition:
        """Make what other threads trigger, so that this one calls back."""
        made = self.node.create_guard_condition(callback)
        self.at_end(self.node.destroy_guard_condition, made)
        return made

    def at_end(self, function: Callable[..., object], *arguments: Any) -> None:
        """Call a function in close(), before those that were given earlier."""
        self._ends.callback(function, *arguments)

    def close(self) -> None:
        """Take everything back, what was made last first."""
        self._ends.close()


def message_class(kind: str) -> Any:
    """Return the class of a message type; raises ImportError where its package is missing."""
    package, _, name = kind.split('/')
    return getattr(import_module(f'{package}.msg'), name)
