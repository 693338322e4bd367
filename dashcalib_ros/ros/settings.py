"""The node's settings and its command line; no ROS is imported.

Writes config/calibrator.yaml: python -m dashcalib_ros.ros.settings > config/calibrator.yaml.
"""
from __future__ import annotations

import dataclasses
import itertools
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from dashcalib_ros.config import Config, _check, describe, expert, setting
from dashcalib_ros.errors import ConfigError, InputError
from dashcalib_ros.limits import YAML_BYTES, parse_yaml, read_text

# these take effect at once; all others are read-only while the node runs
CHANGEABLE = ('commit', 'publish_stale', 'turns.wanted')
HELP = """\
usage: ros2 run dashcalib_ros calibrator [--lifecycle]
           [--ros-args -r FROM:=TO -p NAME:=VALUE --params-file FILE ...]
       calibrator ...     where it was installed by pip

Learns a camera from the turns that the car takes. Nothing is published on
camera_info until a calibration is accepted; from then on each image has its
camera_info.

options:
  -h, --help     show this help and exit
  --lifecycle    be a managed node: it waits for configure and activate

topics, in the node's namespace:
  image_raw               in   sensor_msgs/Image, or image_raw/compressed with
                               image_transport:=compressed; remap image_raw
  camera_info             out  sensor_msgs/CameraInfo, one for each image; with
                               check_only it is the driver's, and comes in
  ~/calibration           out  the same, latched; K[0] = 0 when it is taken back
  ~/check                 out  std_msgs/String, JSON, latched: is the driver's
                               calibration right? with check_only only
  ~/mount                 out  geometry_msgs/PoseWithCovarianceStamped, latched:
                               how the camera sits on the car
  ~/turn_magnitude        out  std_msgs/Float64, for plotting
  ~/overlay/compressed    out  tracks, mask and state, while someone subscribes
  ~/rectified/compressed  out  without distortion, while someone subscribes
  /diagnostics            out  what is missing, once a second

services (std_srvs/Trigger): ~/calibrate, ~/reset, ~/save

main parameters (* may be changed while the node runs):
{parameters}
All {count} parameters: config/calibrator.yaml in the package's share folder.

example:
  ros2 run dashcalib_ros calibrator --ros-args -r __ns:=/front \\
      -r image_raw:=image -p image_transport:=compressed -p turns.wanted:=3
"""
SAMPLE = """\
# Every parameter of the node 'calibrator' with its default: first those that users set, then those
# for experts. Made by dashcalib_ros.ros.settings from the code's own settings; keep only the lines
# that you change. Names with a dot, seed, threads, model, rectified, max_width and min_width are
# settings of the core, which dashcalib run --set NAME=VALUE takes, too; the others are the node's
# own. Topics are remapped, not parameters: image_raw in, camera_info out.
/**:
  ros__parameters:
{users}
    # For experts: few users need these. What was measured for them: benchmark/settings.md
{experts}"""
# settings of the core that are most often set
CORE = ('model', 'rectified', 'turns.wanted', 'turns.store', 'motion.rate', 'verdict.max_sigma')


@dataclass(frozen=True)
class NodeConfig:
    """The node's own settings. Raises ConfigError like Config."""

    image_transport: str = setting(
        'raw', 'compressed subscribes image_raw/compressed instead; video: packets of H.264 or '
               'H.265 on image_raw/ffmpeg, /foxglove or /compressed, or on image_raw itself',
        choices=('raw', 'compressed', 'video'))
    reliability: str = expert(
        'auto', 'auto does as the publishers do: best effort if any of them does',
        choices=('auto', 'best_effort', 'reliable'))
    camera_name: str = setting(
        '', "in the file and its name; empty: the namespace of the images' topic, or dashcam")
    camera_info_url: str = setting(
        '', 'of the accepted calibration: a path, file:// or package://, with ${ROS_HOME} and '
            '${NAME}; empty: file://${ROS_HOME}/camera_info/${NAME}.yaml')
    mask_file: str = setting(
        '', 'picture as large as the images, black where they are not used; empty: none')
    commit: bool = setting(
        False, 'give an accepted calibration to the camera driver: service set_camera_info')
    publish_stale: bool = expert(
        False, 'go on publishing a calibration that new turns contradict')
    check_only: bool = setting(
        False, 'only check the calibration that the driver publishes on camera_info; nothing is '
               'published there, saved or committed')
    base_frame: str = setting('base_link', 'of the car: in it ~/mount says where the camera is')
    publish_tf: bool = setting(
        False, 'one static transform from base_frame to camera_frame, once the mounting is known')
    camera_frame: str = expert('', "for publish_tf; empty: the images' frame_id")
    mount_x: float = setting(0.0, 'm ahead of base_frame, as measured by hand', -50.0, 50.0)
    mount_y: float = setting(0.0, 'm to the left of it', -50.0, 50.0)
    mount_z: float = setting(0.0, 'm above it; 0: as found, where speed is known', -50.0, 50.0)
    imu_topic: str = setting('', 'sensor_msgs/Imu of the car, a witness of fx; empty: none')
    odom_topic: str = setting('', 'nav_msgs/Odometry, for the height by its speed; empty: none')
    fix_topic: str = setting('', 'sensor_msgs/NavSatFix, a witness of fx; empty: none')
    queue_size: int = expert(
        10, 'images that may wait for detection, a second of them; the oldest is dropped', 1, 1000)
    preview_rate: float = expert(
        5.0, 'Hz; overlay and rectified picture at the most: people follow a drive at 5', 0.1,
        30.0)
    commit_timeout: float = expert(5.0, 's; how long the driver may take to answer', 0.1, 600.0)
    better: float = expert(
        0.7, "ratio; a new calibration replaces the old one when fx's sigma falls to this",
        0.1, 1.0)
    contradictions: int = expert(
        3, 'in a row, before the old calibration is given up: one or two may be chance', 1, 20)

    def __post_init__(self) -> None:
        for spec in dataclasses.fields(self):
            _check(spec.name, spec, getattr(self, spec.name))
        if self.check_only and self.commit:
            raise ConfigError("commit changes the driver's calibration, which check_only only "
                              'checks: set one of them')


def specs() -> dict[str, dataclasses.Field[Any]]:
    """Return every setting by its name: the node's own, then the core's."""
    return {**{spec.name: spec for spec in dataclasses.fields(NodeConfig)}, **dict(describe())}


def with_changes(core: Config, own: NodeConfig, values: Mapping[str, Any]
                 ) -> tuple[Config, NodeConfig]:
    """Return both with settings changed by name; raises ConfigError."""
    names = {spec.name for spec in dataclasses.fields(NodeConfig)}
    return (core.replace({name: value for name, value in values.items() if name not in names}),
            dataclasses.replace(own, **{name: value for name, value in values.items()
                                        if name in names}))


def help_text() -> str:
    """Return what --help prints."""
    known, core = specs(), dict(describe())
    rows = [_row(name, spec) for name, spec in known.items()
            if (name in CORE if name in core else not spec.metadata['expert'])]
    return HELP.format(parameters='\n'.join(rows), count=len(known))


def sample() -> str:
    """Return the text of config/calibrator.yaml."""
    users, experts = (''.join(_line(name, spec) for name, spec in specs().items()
                              if spec.metadata['expert'] is wanted) for wanted in (False, True))
    return SAMPLE.format(users=users, experts=experts)


def parse(argv: Sequence[str]) -> tuple[bool, bool]:
    """Return whether help is wanted, and whether the node is to be a lifecycle node.

    argv: without the program's name. Raises ConfigError for arguments that there are not.
    """
    own, of_ros = [], False
    for argument in argv:  # those between --ros-args and -- are for ROS
        if argument == '--ros-args':
            of_ros = True
        elif of_ros:
            of_ros = argument != '--'
        elif argument in ('-h', '--help', '--lifecycle'):
            own.append(argument)
        else:
            raise ConfigError(f'unknown argument {argument!r}: topics and parameters go after '
                              f'--ros-args, as in --ros-args -r image_raw:=/camera/image_raw; '
                              f'--help tells more')
    return '-h' in own or '--help' in own, '--lifecycle' in own


def check_files(argv: Sequence[str]) -> None:
    """Check the files of parameters; raises InputError in one line, where rcl prints several."""
    for option, name in itertools.pairwise(argv):
        if option != '--params-file':
            continue
        data = parse_yaml(read_text(Path(name), YAML_BYTES), name)
        if not _has_parameters(data):
            raise InputError(f"{name} is no file of parameters: it begins with '/**:' (or the "
                             f"node's name), then 'ros__parameters:', each indented below")


def _has_parameters(data: object) -> bool:
    """Return whether ros__parameters stands below a node's name, in namespaces or not."""
    return isinstance(data, dict) and any(
        isinstance(value, dict) if name == 'ros__parameters' else _has_parameters(value)
        for name, value in data.items())


def _row(name: str, spec: dataclasses.Field[Any]) -> str:
    value = f'{spec.default}'.lower() if isinstance(spec.default, bool) else f'{spec.default!r}'
    text = f'{spec.metadata["reason"]}; default {value}{_choices(spec)}'
    name += ' *' if name in CHANGEABLE else ''
    return textwrap.fill(text, 80, initial_indent=f'  {name:<21}', subsequent_indent=' ' * 23)


def _line(name: str, spec: dataclasses.Field[Any]) -> str:
    about = spec.metadata
    note = f'{about["reason"]}{_choices(spec)}'
    if about['minimum'] is not None:
        note += f'; {about["minimum"]:.10g} to {about["maximum"]:.10g}'
    if name in CHANGEABLE:
        note += '; may be changed while the node runs'
    value = yaml.safe_dump(spec.default, default_flow_style=True).split('\n')[0]
    comment = textwrap.fill(note, 99, initial_indent='    # ', subsequent_indent='    # ')
    return f'{comment}\n    {name}: {value}\n'


def _choices(spec: dataclasses.Field[Any]) -> str:
    choices = spec.metadata['choices']
    return f'; one of {", ".join(choices)}' if choices else ''


if __name__ == '__main__':
    print(sample(), end='')
