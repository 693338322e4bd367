"""Publishers and subscriptions whose QoS users may override, with qos_overrides parameters."""
from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSPolicyKind, QoSProfile
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions
from rclpy.subscription import Subscription

from dashcalib_ros.errors import ConfigError

# durability is not among them: a latched topic that is not latched would break its readers
POLICIES = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY)


def make_publisher(node: Node, kind: type, topic: str, profile: QoSProfile) -> Publisher:
    """Make a publisher; raises ConfigError for an override that QoS has not."""
    options = QoSOverridingOptions(POLICIES, callback=_checked)
    with _told(topic, 'publisher'):
        return node.create_publisher(kind, topic, profile, qos_overriding_options=options)


def make_subscription(node: Node, kind: type, topic: str, callback: Callable[[Any], None],
                      profile: QoSProfile, fixed: Iterable[QoSPolicyKind] = ()) -> Subscription:
    """Make a subscription; fixed: policies that are not for the user.

    Raises ConfigError for an override that QoS has not.
    """
    options = QoSOverridingOptions([each for each in POLICIES if each not in fixed],
                                   callback=_checked)
    with _told(topic, 'subscription'):
        return node.create_subscription(kind, topic, callback, profile,
                                        qos_overriding_options=options)


def override_of(node: Node, topic: str, policy: QoSPolicyKind) -> Any:
    """Return the user's value of a policy of a subscription, None if there is none."""
    name = f'qos_overrides.{topic}.subscription.{policy.name.lower()}'
    given = node._parameter_overrides.get(name)
    return None if given is None else given.value


def _checked(profile: QoSProfile) -> SetParametersResult:
    return SetParametersResult(successful=profile.depth > 0, reason='depth must be 1 or more')


@contextmanager
def _told(topic: str, what: str) -> Iterator[None]:
    """Turn what rclpy raises for an odd override into a ConfigError."""
    try:
        yield
    except (RuntimeError, InvalidQosOverridesError) as error:
        raise ConfigError(f'qos_overrides of the {what} of {topic}: {error}; history is keep_last '
                          f'or keep_all, depth a number, reliability reliable or '
                          f'best_effort') from error
