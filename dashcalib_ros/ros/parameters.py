"""The node's parameters: settings of the core by their own names, the node's own, and QoS."""
from __future__ import annotations

import dataclasses
import difflib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSPolicyKind, QoSProfile
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions
from rclpy.subscription import Subscription
from std_srvs.srv import Trigger

from dashcalib_ros.config import Config, describe
from dashcalib_ros.errors import ConfigError
from dashcalib_ros.report.result import CAMERA_NAME
from dashcalib_ros.ros.settings import CHANGEABLE, NodeConfig

# of the QoS that users may override: durability is not among them, as a latched topic that is not
# latched would break its readers
POLICIES = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY)


def declare(node: Node) -> tuple[Config, NodeConfig]:
    """Declare the parameters on the node and return what was given.

    Those for experts are declared where they are given, so that a list of all fits a screen.
    Raises ConfigError, or rclpy's ParameterException for a value out of its range.
    """
    given = node._parameter_overrides
    changes = {name: _declared(node, name, spec) for name, spec in describe()
               if not spec.metadata['expert'] or name in given}
    own = {spec.name: _declared(node, spec.name, spec) for spec in dataclasses.fields(NodeConfig)}
    return Config().replace(changes), NodeConfig(**_floats(own))


def check_known(names: Iterable[str], declared: Iterable[str]) -> None:
    """Check that each parameter that was given is one of this node.

    Raises ConfigError with the nearest name that there is.
    """
    known = [*declared, *(name for name, _ in describe())]
    for name in names:
        if name in known:
            continue
        near = difflib.get_close_matches(name, known, 1)
        raise ConfigError(f'there is no parameter {name!r}' + (
            f': did you mean {near[0]}?' if near else
            ': remove it; if it is for another node, name that node in the file, not /**'))


def changed(core: Config, own: NodeConfig, parameters: Iterable[Parameter], most_turns: int
            ) -> tuple[Config, NodeConfig, SetParametersResult]:
    """Return the changed settings, or the same ones and the reason for the refusal.

    most_turns: how many turns the learner was made for.
    """
    values = {each.name: each.value for each in parameters if each.name in CHANGEABLE}
    of_core = {name: values.pop(name) for name in list(values) if '.' in name}
    try:
        new = core.replace(of_core), dataclasses.replace(own, **values)
    except ConfigError as error:
        return core, own, SetParametersResult(successful=False, reason=str(error))
    if new[0].turns.wanted > most_turns:
        return core, own, SetParametersResult(successful=False, reason=(
            f'turns.wanted can be {most_turns} at the most while the node runs, as so many turns '
            f'are kept; for more, start the node with it'))
    return *new, SetParametersResult(successful=True)


def why_read_only(name: str) -> str:
    """Return why a parameter cannot be changed while the node runs, and what to do instead."""
    if name in Config().flat():
        why = 'the turns found so far were made with it'
    elif name.startswith('qos_overrides'):
        why = 'the topic was made with it'
    else:
        why = 'it is read when the node starts'
    return (f'{name} is read-only while the node runs: {why}; start the node with '
            f'-p {name}:=VALUE. These can be changed: {", ".join(CHANGEABLE)}')


def refusal(request: Any, response: Any, reason: str) -> Any:
    """Return the response of a service that failed; what its fields are by themselves is no."""
    failed = SetParametersResult(successful=False, reason=reason)
    if isinstance(response, SetParameters.Response):
        response.results += [failed] * (len(request.parameters) - len(response.results))
    elif isinstance(response, SetParametersAtomically.Response):
        response.result = failed
    elif isinstance(response, Trigger.Response):
        response.success, response.message = False, reason
    return response


def camera_name(config: NodeConfig, topic: str) -> str:
    """Return the camera's name; images on /camera/front/image_raw are of camera_front."""
    namespace = topic.rpartition('/')[0].strip('/')
    return config.camera_name or re.sub(r'[^A-Za-z0-9_]', '_', namespace) or CAMERA_NAME


def _declared(node: Node, name: str, spec: dataclasses.Field[Any]) -> Any:
    about = spec.metadata
    descriptor = ParameterDescriptor(
        description=about['reason'] + (' (for experts)' if about['expert'] else ''),
        read_only=name not in CHANGEABLE,
        # the config checks the types: it accepts 3 for 3.0, and its messages name the cure
        dynamic_typing=True,
        additional_constraints=f'one of {", ".join(about["choices"])}' if about['choices'] else '')
    low, high = about['minimum'], about['maximum']
    if low is not None and isinstance(spec.default, float):
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=float(low), to_value=float(high))]
    elif low is not None:
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=1)]
    return node.declare_parameter(name, spec.default, descriptor).value


def _floats(values: Mapping[str, Any]) -> dict[str, Any]:
    """Let an integer be a float where the default is one."""
    defaults = NodeConfig()
    return {name: float(value) if type(value) is int and isinstance(getattr(defaults, name), float)
            else value for name, value in values.items()}


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
