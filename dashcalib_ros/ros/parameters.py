"""The node's parameters: every setting of the core by its own name, and the node's own."""
from __future__ import annotations

import dataclasses
import difflib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from dashcalib_ros.config import Config, _check, describe, expert, setting
from dashcalib_ros.errors import ConfigError

# these take effect at once; the others affect turns that are already found: they are read-only
CHANGEABLE = ('commit', 'publish_stale')
OF_ROS = ('use_sim_time', 'start_type_description_service', 'qos_overrides')


@dataclass(frozen=True)
class NodeConfig:
    """What only the node needs. Raises ConfigError like Config."""

    image_transport: str = setting(
        'raw', 'compressed subscribes image_raw/compressed instead',
        choices=('raw', 'compressed'))
    reliability: str = setting(
        'auto', 'auto does as the publishers do: best effort if any of them does',
        choices=('auto', 'best_effort', 'reliable'))
    camera_name: str = setting(
        '', "in the file and its name; empty: the last part of the node's namespace, or dashcam")
    camera_info_file: str = setting(
        '', 'of the accepted calibration; empty: $ROS_HOME/camera_info/CAMERA_NAME.yaml')
    mask_file: str = setting(
        '', 'picture as large as the images, black where they are not used; empty: none')
    commit: bool = setting(
        False, 'give an accepted calibration to the camera driver: service set_camera_info')
    publish_stale: bool = setting(
        False, 'go on publishing a calibration that new turns contradict')
    queue_size: int = expert(
        10, 'images that may wait for detection, a second of them; the oldest is dropped', 1, 1000)
    commit_timeout: float = expert(5.0, 's; how long the driver may take to answer', 0.1, 600.0)
    better: float = expert(
        0.7, "ratio; a new calibration replaces the old one when fx's sigma falls to this",
        0.1, 1.0)
    contradictions: int = expert(
        3, 'in a row, before the old calibration is given up: one or two may be chance', 1, 20)

    def __post_init__(self) -> None:
        for spec in dataclasses.fields(self):
            _check(spec.name, spec, getattr(self, spec.name))


def declare(node: Node) -> tuple[Config, NodeConfig]:
    """Declare every parameter on the node and return what was given.

    Raises ConfigError, or rclpy's ParameterException for a value out of its range.
    """
    changes = {name: _declared(node, name, spec) for name, spec in describe()}
    own = {spec.name: _declared(node, spec.name, spec) for spec in dataclasses.fields(NodeConfig)}
    return Config().replace(changes), NodeConfig(**_floats(own))


def unknown(names: Iterable[str]) -> list[str]:
    """Return a line for each name that is no parameter of this node."""
    known = [*Config().flat(), *(spec.name for spec in dataclasses.fields(NodeConfig))]
    lines = []
    for name in names:
        if name in known or name.partition('.')[0] in OF_ROS:
            continue
        near = difflib.get_close_matches(name, known, 1)
        lines.append(f'there is no parameter {name!r}'
                     + (f': did you mean {near[0]}?' if near else '; it is ignored'))
    return lines


def changed(config: NodeConfig, parameters: Iterable[Parameter]
            ) -> tuple[NodeConfig, SetParametersResult]:
    """Return the changed settings, or the same ones and the reason for the refusal."""
    values = {each.name: each.value for each in parameters if each.name in CHANGEABLE}
    try:
        return dataclasses.replace(config, **values), SetParametersResult(successful=True)
    except ConfigError as error:
        return config, SetParametersResult(successful=False, reason=str(error))


def camera_name(config: NodeConfig, namespace: str) -> str:
    """Return the camera's name; a node in /front calibrates the camera called front."""
    if config.camera_name:
        return config.camera_name
    last = namespace.rstrip('/').rpartition('/')[2]
    return re.sub(r'[^A-Za-z0-9_]', '_', last) or 'dashcam'


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
