# SPDX-License-Identifier: Apache-2.0
"""The node's parameters: settings of the core by their own names, the node's own, and QoS."""
from __future__ import annotations

import dataclasses
import difflib
import functools
import math
import re
from collections.abc import Collection, Iterable, Mapping
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rcl_interfaces.srv import ListParameters, SetParameters, SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter

from dashcalib_ros.config import Config, present_name
from dashcalib_ros.errors import ConfigError
from dashcalib_ros.formats.ros import CAMERA_NAME
from dashcalib_ros.ros.settings import (
    CHANGEABLE,
    NodeConfig,
    Settings,
    ros_value,
    specs,
    with_changes,
)

RELIABILITIES = ('best_effort', 'reliable')


def given_parameters(program: str) -> dict[str, Any]:
    """Return the parameters that a program's node is given at the start, known or not.

    rclpy tells them only by declaring all, without ranges and for good: on a node of their own.
    rclcpp does not tell them either (its issue 1907).
    """
    make = functools.partial(Node, program, enable_rosout=False, start_parameter_services=False)
    try:
        probe = make(automatically_declare_parameters_from_overrides=True)
    except ValueError:
        # an empty list, maybe of another node, has no type: rclpy then takes none of them
        probe = make()
        for name in specs(program):
            probe.declare_parameter(name, None, ParameterDescriptor(dynamic_typing=True))
    try:
        given = {name: probe.get_parameter(name).value for name in declared_names(probe)}
    finally:
        probe.destroy_node()
    return {present_name(name): value for name, value in given.items() if value is not None}


def declare(node: Node, program: str, given: Mapping[str, Any]) -> Settings:
    """Declare the parameters on the node and return their values.

    Those for experts are declared where they are given, so that a list of all fits a screen.
    Raises ConfigError.
    """
    for name, value in given.items():
        if name.startswith('qos_overrides.'):
            _check_qos(name, value)
    if given.get('check_only') is True:
        raise ConfigError('E-CHECK-ONLY-REMOVED',
                          'check_only is a program of its own now: start checker instead of '
                          'calibrator, without this parameter')
    known = specs(program)
    core, own = with_changes(Config(), NodeConfig(), {
        name: value for name, value in given.items() if name in known})
    values = {**core.flat(), **dataclasses.asdict(own)}
    for name, spec in known.items():
        if not spec.metadata['expert'] or name in given:
            # the checked value, which rclpy would refuse itself where 3 stands for 3.0
            value = ros_value(spec, values[name])
            node.declare_parameter(
                name, float(value) if isinstance(spec.default, float) else value,
                _descriptor(name, spec), ignore_override=True)
    return Settings(core, own)


def unknown_text(node: Node, program: str, names: Collection[str]) -> str:
    """Return a line about parameters that the node does not have; '' where it has all."""
    known = {*declared_names(node), *specs(program)}
    found = []
    for name in sorted(set(names) - known):
        near = difflib.get_close_matches(name, known, 1)
        found.append(name + (f' (did you mean {near[0]}?)' if near else ''))
    return f'there is no parameter {", ".join(found)}' if found else ''


def declared_names(node: Node) -> list[str]:
    """Return the names of all parameters of a node."""
    return list(node.list_parameters([], ListParameters.Request.DEPTH_RECURSIVE).names)


def check_changeable(node: Node, program: str, names: Iterable[str]) -> None:
    """Check that parameters exist and may be changed while the node runs; raises ConfigError."""
    for name in names:
        if text := unknown_text(node, program, [name]):
            raise ConfigError('E-PARAMETER-UNKNOWN', text)
        # those for experts are not declared unless they were given
        if not node.has_parameter(name) or node.describe_parameter(name).read_only:
            changeable = ', '.join(each for each in CHANGEABLE if node.has_parameter(each))
            raise ConfigError('E-PARAMETER-READ-ONLY',
                              f'{name} is read-only while the node runs: start the node with '
                              f'-p {name}:=VALUE. These can be changed: {changeable}')


def changed(settings: Settings, parameters: Iterable[Parameter], most_turns: int) -> Settings:
    """Return the changed settings; raises ConfigError.

    most_turns: how many turns the learner was made for.
    """
    new = Settings(*with_changes(settings.core, settings.own, {
        each.name: each.value for each in parameters if each.name in CHANGEABLE}))
    wanted = new.core.turns.wanted
    if wanted > most_turns:
        raise ConfigError('E-TURNS-ABOVE-CAPACITY',
                          f'turns.wanted can be at most {most_turns} while the node runs, which '
                          f'keeps {most_turns} turns; for more, start the node with '
                          f'-p turns.wanted:={wanted}')
    return new


def refusal(request: Any, response: Any, reason: str) -> Any:
    """Return the response of a service that failed; what its fields are by themselves is no."""
    failed = SetParametersResult(successful=False, reason=reason)
    if isinstance(response, SetParameters.Response):
        response.results += [failed] * (len(request.parameters) - len(response.results))
    elif isinstance(response, SetParametersAtomically.Response):
        response.result = failed
    return response


def camera_name(config: NodeConfig, topic: str) -> str:
    """Return the camera's name; images on /camera/front/image_raw are of camera_front."""
    namespace = topic.rpartition('/')[0].strip('/')
    return config.camera_name or re.sub(r'[^A-Za-z0-9_]', '_', namespace) or CAMERA_NAME


def _descriptor(name: str, spec: dataclasses.Field[Any]) -> ParameterDescriptor:
    about = spec.metadata
    descriptor = ParameterDescriptor(
        description=about['reason'] + (' (for experts)' if about['expert'] else ''),
        read_only=name not in CHANGEABLE,
        additional_constraints=f'one of {", ".join(about["choices"])}' if about['choices'] else '')
    low, high = about['minimum'], about['maximum']
    # rclpy's range has no place for NaN; with_changes() has checked it
    if low is not None and isinstance(spec.default, float) and not math.isnan(spec.default):
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=float(low), to_value=float(high))]
    elif low is not None and isinstance(spec.default, int):
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=1)]
    return descriptor


def _check_qos(name: str, value: Any) -> None:
    policy = name.rpartition('.')[2]
    fits = {'history': value in ('keep_last', 'keep_all'), 'reliability': value in RELIABILITIES,
            'depth': type(value) is int and value > 0}
    if not fits.get(policy, True):
        raise ConfigError('E-QOS-OVERRIDE-INVALID',
                          f'{name} cannot be {value!r}: history is keep_last or keep_all, depth a '
                          f'whole number of at least 1, reliability reliable or best_effort')
