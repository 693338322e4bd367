"""The node's parameters: settings of the core by their own names, the node's own, and QoS."""
from __future__ import annotations

import dataclasses
import difflib
import re
from collections.abc import Iterable
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
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from std_srvs.srv import Trigger

from dashcalib_ros.config import Config
from dashcalib_ros.errors import ConfigError
from dashcalib_ros.report.result import CAMERA_NAME
from dashcalib_ros.ros.settings import CHANGEABLE, NodeConfig, specs, with_changes

# history, depth and reliability; not durability, as a latched topic that is not latched would
# break its readers
OVERRIDES = QoSOverridingOptions.with_default_policies()
RELIABILITIES = ('best_effort', 'reliable')


def latched() -> QoSProfile:
    """Return the QoS of a topic that late subscribers get; rclpy writes overrides into it."""
    return QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def declare(node: Node) -> tuple[Config, NodeConfig]:
    """Declare the parameters on the node and return what was given.

    Those for experts are declared where they are given, so that a list of all fits a screen.
    Raises ConfigError, or rclpy's ParameterException for a value out of its range.
    """
    given = node._parameter_overrides
    for name, parameter in given.items():
        if name.startswith('qos_overrides.'):
            _check_qos(name, parameter.value)
    return with_changes(Config(), NodeConfig(), {
        name: _declared(node, name, spec) for name, spec in specs().items()
        if not spec.metadata['expert'] or name in CHANGEABLE or name in given})


def check_known(names: Iterable[str], declared: Iterable[str]) -> None:
    """Check that each parameter that was given is one of this node.

    Raises ConfigError with the nearest name.
    """
    known = [*declared, *specs()]
    for name in names:
        if name in known:
            continue
        near = difflib.get_close_matches(name, known, 1)
        raise ConfigError('E-PARAMETER-UNKNOWN', f'there is no parameter {name!r}' + (
            f': did you mean {near[0]}?' if near else
            ': remove it; if it is for another node, name that node in the parameter file instead '
            'of /**'))


def check_changeable(node: Node, names: Iterable[str]) -> None:
    """Check that parameters exist and may be changed while the node runs; raises ConfigError."""
    names = tuple(names)
    check_known(names, node._parameters)
    for name in names:
        # those for experts are not declared unless they were given
        if not node.has_parameter(name) or node.describe_parameter(name).read_only:
            raise ConfigError('E-PARAMETER-READ-ONLY',
                              f'{name} is read-only while the node runs: start the node with '
                              f'-p {name}:=VALUE. These can be changed: {", ".join(CHANGEABLE)}')


def changed(core: Config, own: NodeConfig, parameters: Iterable[Parameter], most_turns: int
            ) -> tuple[Config, NodeConfig]:
    """Return the changed settings; raises ConfigError.

    most_turns: how many turns the learner was made for.
    """
    new = with_changes(core, own, {
        each.name: each.value for each in parameters if each.name in CHANGEABLE})
    if new[0].turns.wanted > most_turns:
        raise ConfigError('E-TURNS-ABOVE-CAPACITY',
                          f'turns.wanted can be at most {most_turns} while the node runs, which '
                          f'keeps {most_turns} turns; for more, start the node with '
                          f'-p turns.wanted:={new[0].turns.wanted}')
    return new


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


def _check_qos(name: str, value: Any) -> None:
    policy = name.rpartition('.')[2]
    fits = {'history': value in ('keep_last', 'keep_all'), 'reliability': value in RELIABILITIES,
            'depth': type(value) is int and value > 0}
    if not fits.get(policy, True):
        raise ConfigError('E-QOS-OVERRIDE-INVALID',
                          f'{name} cannot be {value!r}: history is keep_last or keep_all, depth a '
                          f'whole number of at least 1, reliability reliable or best_effort')
