# SPDX-License-Identifier: Apache-2.0
"""What a node has in ROS, without ROS's graph."""
from __future__ import annotations

from types import SimpleNamespace

from builtin_interfaces.msg import Time
from fakes import stands_in_for

from dashcalib_ros.ros.diagnostics import Complaints
from dashcalib_ros.ros.endpoints import Endpoints, message_class
from dashcalib_ros.ros.interface import PUBLISHED


@stands_in_for(Endpoints)
class FakeEndpoints:
    """Keeps what is published, and the callbacks of subscriptions and timers."""

    def __init__(self, node, log, complaints, given):
        self.published, self.heard, self.lines, self.ends = [], {}, [], []
        self.complaints = Complaints(self.lines.append)
        self.log = SimpleNamespace(warning=self.lines.append, info=self.lines.append)
        self.node = SimpleNamespace(
            get_clock=lambda: SimpleNamespace(now=lambda: SimpleNamespace(to_msg=Time)))

    def latched(self, name):
        message_class(PUBLISHED[name].type)
        return lambda message: self.published.append((name, message))

    def subscription(self, name, callback, topic=''):
        self.heard[topic or name] = callback

    def timer(self, period_s, callback):
        pass

    def publisher(self, name):
        return SimpleNamespace(publish=lambda message: self.published.append((name, message)))

    def service(self, name, action):
        pass

    def at_end(self, function, *arguments):
        self.ends.append(function)


def transforms(endpoints):
    """Return what was sent, each as a list of transforms."""
    return [message.transforms for topic, message in endpoints.published if topic == '/tf_static']
