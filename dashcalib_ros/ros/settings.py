# SPDX-License-Identifier: Apache-2.0
"""The node's settings and its command line; no ROS is imported."""
from __future__ import annotations

import dataclasses
import itertools
import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from dashcalib_ros.config import RENAMED, Config, _check, describe, expert, setting
from dashcalib_ros.errors import ConfigError, InputError
from dashcalib_ros.limits import YAML_BYTES, parse_yaml, read_text
from dashcalib_ros.ros.interface import (
    CALIBRATOR,
    CHECKER,
    PUBLISHED,
    RIG,
    SERVICES,
    SUBSCRIBED,
)

# an array of integers; the core has it as a text
LIST = 'mask.segmentation_classes'
# these take effect at once; all others are read-only while the node runs
CHANGEABLE = ('commit', 'publish_stale', 'turns.wanted')
# a checker publishes and keeps nothing
CALIBRATOR_ONLY = frozenset((
    'camera_info_url', 'commit', 'commit_timeout', 'publish_stale', 'contradictions',
    'base_frame', 'publish_tf', 'camera_frame', 'mount_x', 'mount_y', 'mount_z'))
# that only a rig has; what else it has of the node's own, and of the core, by how names begin
RIG_ONLY = frozenset(('cameras', 'stores'))
OF_RIG = ('cameras', 'stores', 'autostart', 'use_odom', 'model', 'known.', 'rig.', 'intrinsics.',
          'scene.', 'turns.half_width')
HELP = """\
usage: ros2 run dashcalib_ros {program}
           [--ros-args -r FROM:=TO -p NAME:=VALUE --params-file FILE ...]
       dashcalib-{program} ...     the same, installed with pip

{purpose}

options:
  -h, --help     show this help and exit

topics, in the node's namespace (in: remap {input}; out: reliable):
{topics}

services (std_srvs/Trigger): {services}

main parameters (* may be changed while the node runs):
{parameters}
All {count} parameters: config/calibrator.yaml in the package's share folder.

example:
  dashcalib-{program} --ros-args {example}
"""
EXAMPLE = """-r __ns:=/front \\
      -r image_raw:=image -p image_transport:=compressed -p turns.wanted:=3"""
EXAMPLE_OF_RIG = """-p cameras:='front left rear' \\
      -p stores:=/data/turns -p use_odom:=true -r odom:=/car/odom"""
PURPOSES = {
    CALIBRATOR: 'Learns a camera from the turns that the car takes. Nothing is published on '
                'camera_info until a calibration is accepted; from then on each image has its '
                'camera_info.',
    CHECKER: 'Checks the calibration that a camera driver publishes on camera_info, with the '
             'turns that the car takes. It publishes no calibration, saves and changes nothing.',
    RIG: 'Places the cameras of one car against the first one by the turns that their calibrators '
         'store, publishes static transforms once a rig is accepted, and names a camera that was '
         'moved since.'}
# settings of the core that are most often set
CORE = ('model', 'rectified', 'turns.wanted', 'turns.store', 'tracking.rate', 'verdict.max_sigma')


@dataclass(frozen=True)
class NodeConfig:
    """The node's own settings. Raises ConfigError like Config."""

    autostart: bool = setting(
        True, 'listen at once; false: wait for a lifecycle manager to configure and activate')
    image_transport: str = setting(
        'raw', 'raw subscribes to image_raw, compressed to image_raw/compressed, video to packets '
               'of H.264 or H.265 on image_raw/ffmpeg, /foxglove or /compressed, or on image_raw',
        choices=('raw', 'compressed', 'video'))
    reliability: str = expert(
        'auto', 'auto: reliable if all publishers are reliable, else best effort',
        choices=('auto', 'best_effort', 'reliable'))
    camera_name: str = setting(
        '', 'name of the camera, which its calibration file has, too; empty: the namespace of the '
            'image topic, or dashcam')
    camera_info_url: str = setting(
        '', 'place of the accepted calibration: a path, file:// or package://, with ${ROS_HOME} '
            'and ${NAME}; empty: file://${ROS_HOME}/camera_info/${NAME}.yaml')
    mask_file: str = setting(
        '', 'picture of the size of the images, black where pixels are not used; empty: none')
    commit: bool = setting(
        False, 'send each accepted calibration to the camera driver: service set_camera_info')
    publish_stale: bool = setting(
        False, 'continue to publish a calibration that new turns contradict')
    base_frame: str = setting(
        '', 'frame of the car for ~/mount and publish_tf; empty: base_link where mount_z is set, '
            'else base_footprint, as the estimated height is above the road')
    publish_tf: bool = setting(
        False, 'publish static transforms from base_frame to the camera, when mounting and '
               'position are known; not with ROS 2 from pip, which has no tf2_msgs')
    camera_frame: str = expert(
        '', 'optical frame of the camera for publish_tf; empty: the frame_id of the images')
    mount_x: float = setting(
        math.nan, 'm ahead of base_frame, measured by hand; .nan: not known', -50.0, 50.0)
    mount_y: float = setting(
        math.nan, 'm to the left of base_frame, measured by hand; .nan: not known', -50.0, 50.0)
    mount_z: float = setting(
        math.nan, 'm above base_frame, measured by hand; .nan: the height above the road, which '
                  'is estimated where the speed is known', -50.0, 50.0)
    use_imu: bool = setting(
        False, 'subscribe imu (sensor_msgs/Imu of the car), independent evidence for fx')
    use_odom: bool = setting(
        False, 'subscribe odom (nav_msgs/Odometry), whose speed gives the height of the camera')
    use_fix: bool = setting(
        False, 'subscribe fix (sensor_msgs/NavSatFix), independent evidence for fx')
    use_temperature: bool = setting(
        False, 'subscribe temperature (sensor_msgs/Temperature of the camera), which the focal '
               'length may follow')
    cameras: str = setting(
        '', "names of the car's cameras, with spaces between them, the base first: the calibrator "
            'of each has its name for a namespace')
    stores: str = setting(
        '~/.ros/dashcalib_turns', "folder in which each camera's calibrator has its turns.store, "
                                  "which has the camera's name; the rig is kept in rig.json there")
    imu_topic: str = expert('', 'deprecated: set use_imu, and remap imu with -r imu:=TOPIC')
    odom_topic: str = expert('', 'deprecated: set use_odom, and remap odom with -r odom:=TOPIC')
    fix_topic: str = expert('', 'deprecated: set use_fix, and remap fix with -r fix:=TOPIC')
    queue_size: int = expert(
        10, 'images that may wait for detection, one second of them; then the oldest is dropped',
        1, 1000)
    preview_rate: float = expert(
        5.0, 'Hz; highest rate of the overlay and of the rectified picture', 0.1, 30.0)
    commit_timeout: float = expert(
        5.0, 's; how long the node waits for the answer of the driver', 0.1, 600.0)
    contradictions: int = expert(
        3, 'contradictions in a row before the old calibration is withdrawn; one or two may be '
           'chance', 1, 20)

    def __post_init__(self) -> None:
        for spec in dataclasses.fields(self):
            _check(spec.name, spec, getattr(self, spec.name))


@dataclass(frozen=True)
class Settings:
    """The values of all parameters: of the core, and the node's own."""

    core: Config
    own: NodeConfig


def specs(program: str = CALIBRATOR) -> dict[str, dataclasses.Field[Any]]:
    """Return a program's settings by name: the node's own, then the core's."""
    found = {**{spec.name: spec for spec in dataclasses.fields(NodeConfig)}, **dict(describe())}
    return {name: spec for name, spec in found.items() if (
        name.startswith(OF_RIG) if program == RIG else name not in RIG_ONLY
        and (program == CALIBRATOR or name not in CALIBRATOR_ONLY))}


def with_changes(core: Config, own: NodeConfig, values: Mapping[str, Any]
                 ) -> tuple[Config, NodeConfig]:
    """Return both with settings changed by name; raises ConfigError.

    values: as parameters have them, see ros_value(), or as the core has them.
    """
    names = {spec.name for spec in dataclasses.fields(NodeConfig)}
    values = {name: ','.join(map(str, value)) if name == LIST and not isinstance(
        value, (int, str)) else value for name, value in values.items()}
    return (core.replace({name: value for name, value in values.items() if name not in names}),
            dataclasses.replace(own, **{name: value for name, value in values.items()
                                        if name in names}))


def ros_value(spec: dataclasses.Field[Any], value: Any) -> Any:
    """Return a setting's value as a parameter has it: the core has a list of numbers as a text."""
    is_list = LIST.endswith(f'.{spec.name}')
    return [int(each) for each in value.split(',')] if is_list else value


def help_text(program: str) -> str:
    """Return what --help of a program prints."""
    known, core = specs(program), dict(describe())
    rows = [_row(name, spec) for name, spec in known.items()
            if (name in CORE if name in core else not spec.metadata['expert'])]
    topics = [_wrapped(f'{name:<22} {way:<3}', f'{topic.type.replace("/msg/", "/")}: '
                                               f'{topic.about}')
              for way, table in (('in', SUBSCRIBED), ('out', PUBLISHED))
              for name, topic in table.items() if program in topic.programs]
    return HELP.format(
        program=program, purpose=textwrap.fill(PURPOSES[program], 80), topics='\n'.join(topics),
        services=', '.join(each.name for each in SERVICES if program in each.programs),
        parameters='\n'.join(rows), count=len(known),
        input='odom' if program == RIG else 'image_raw',
        example=EXAMPLE_OF_RIG if program == RIG else EXAMPLE)


def parse(argv: Sequence[str]) -> tuple[bool, frozenset[str]]:
    """Return whether help is wanted, and the names of parameters that are given with -p.

    argv: without the program's name. Raises ConfigError for unknown arguments.
    """
    wants_help, of_ros, names = False, False, set()
    for argument, value in itertools.zip_longest(argv, argv[1:], fillvalue=''):
        if argument == '--ros-args':  # those between this and -- are for ROS
            of_ros = True
        elif of_ros:
            of_ros = argument != '--'
            if argument in ('-p', '--param'):
                # [NODE:]NAME:=VALUE
                name = value.partition(':=')[0].rpartition(':')[2]
                names.add(RENAMED.get(name, name))
        elif argument in ('-h', '--help'):
            wants_help = True
        else:
            raise ConfigError('E-ARGUMENT-UNKNOWN',
                              f'unknown argument {argument!r}: topics and parameters follow '
                              f'--ros-args, as in --ros-args -r image_raw:=/camera/image_raw; '
                              f'see --help')
    return wants_help, frozenset(names)


def check_files(argv: Sequence[str]) -> None:
    """Check the files of parameters; raises InputError in one line, where rcl prints several."""
    for option, name in itertools.pairwise(argv):
        if option != '--params-file':
            continue
        data = parse_yaml(read_text(Path(name), YAML_BYTES), name)
        if not _has_parameters(data):
            raise InputError('E-PARAMETER-FILE-INVALID',
                             f"{name} is not a parameter file: it must begin with '/**:' (or the "
                             f"name of the node), then 'ros__parameters:', each indented below")


def _has_parameters(data: object) -> bool:
    """Return whether ros__parameters stands below a node's name, in namespaces or not."""
    return isinstance(data, dict) and any(
        isinstance(value, dict) if name == 'ros__parameters' else _has_parameters(value)
        for name, value in data.items())


def _row(name: str, spec: dataclasses.Field[Any]) -> str:
    text = f'{spec.metadata["reason"]}; default {yaml_value(spec.default)}{choices_text(spec)}'
    return _wrapped(f'{name + (" *" if name in CHANGEABLE else ""):<19}', text)


def _wrapped(head: str, text: str) -> str:
    return textwrap.fill(text, 80, initial_indent=f'  {head}  ',
                         subsequent_indent=' ' * (len(head) + 4))


def yaml_value(value: object) -> str:
    """Return a value as a file of parameters, and -p, have it."""
    return yaml.safe_dump(value, default_flow_style=True).split('\n')[0]


def choices_text(spec: dataclasses.Field[Any]) -> str:
    """Return the clause about what a setting's value may be; '' where it is free."""
    choices = spec.metadata['choices']
    return f'; one of {", ".join(choices)}' if choices else ''
