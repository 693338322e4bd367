# SPDX-License-Identifier: Apache-2.0
"""How the camera sits on the car: as URDF, as a static transform, and as VisionPilot's H.yaml.

None is read. H maps a pixel to the road: metres ahead and to the left.
"""
from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera.rotation import quaternion
from dashcalib_ros.errors import ConfigError, visible
from dashcalib_ros.formats.values import Placed
from dashcalib_ros.judge.calibration import Mount
from dashcalib_ros.judge.difference import NamedCamera

BASE = 'base_link'
# files and folders that have the same name for every camera
UNNAMED = ('result', 'calibration', '')
# of an optical frame (z ahead, x to the right, y downwards) against its link (REP-103), degrees
OPTICAL_RPY = (-90.0, 0.0, -90.0)
WRITTEN = {'yaw_left_deg': 'degrees to the left', 'pitch_up_deg': 'degrees upwards',
           'roll_right_deg': 'degrees of roll to the right', 'height_m': 'm above the road'}


def write(found: NamedCamera) -> str:
    """Return a robot of one camera: base_link, the camera's link and its optical frame.

    Raises ConfigError where the mounting is not known.
    """
    mount, name = mount_of(found), _frame_name(found.name)
    about = [
        f'{found.name}: how the camera sits on the car, {mount.verdict}',
        *map(str, mount.reasons),
        *(f'{what}: {_with_sigma(mount, key)}' for key, what in WRITTEN.items()),
        f'x and y are not known: {BASE} is on the road below the camera until you set them']
    return _robot(name, about, BASE, [
        _joint(name, BASE, f'{name}_link', (0.0, 0.0, mount.height_m or 0.0), _rpy(mount)),
        _joint(f'{name}_optical', f'{name}_link', f'{name}_optical_frame', (0.0, 0.0, 0.0),
               OPTICAL_RPY)])


def write_rig(rig: Sequence[Placed]) -> str:
    """Return a robot of the cameras of a rig: their optical frames, from that of the base.

    That one has base_link above it, where its mounting is known.
    """
    root, joints = _steps(rig)
    about = [*(each.about for each in rig), f'{root} is the root; where no metres are known, 0 is '
                                            f'written']
    return _robot('rig', about, root, [
        _joint(child.removesuffix('_optical_frame'), parent, child, place, _angles(turn))
        for parent, child, place, turn in joints])


def write_rig_transforms(rig: Sequence[Placed]) -> str:
    """Return the commands that publish the same as static transforms."""
    lines = [f'# {visible(each.about)}' for each in rig]
    return '\n'.join([*lines, *(_publisher(parent, child, place, quaternion(turn)) + ' &'
                                for parent, child, place, turn in _steps(rig)[1]), 'wait\n'])


def _steps(rig: Sequence[Placed]) -> tuple[str, list[tuple[str, str, list[float], Floats]]]:
    """Return the root, and parent, child, place and rotation (3, 3) of the steps from it."""
    base, steps = rig[0], []
    top = frame_of(base.name)
    if base.mount is not None:
        steps.append((BASE, top, [0.0, 0.0, base.mount.height_m or 0.0], base.mount.rotation))
    for each in rig[1:]:
        back: Floats = np.asarray(np.linalg.inv(each.pose), np.float64)
        steps.append((top, frame_of(each.name), back[:3, 3].tolist(), back[:3, :3]))
    return BASE if base.mount is not None else top, steps


def frame_of(name: str) -> str:
    """Return the name of a camera's optical frame."""
    return f'{_frame_name(f"{name}/result.json")}_optical_frame'


def _robot(name: str, about: Sequence[str], root: str, joints: Sequence[str]) -> str:
    lines = '\n'.join(f'  {_in_comment(each)}' for each in about)
    return (f'<?xml version="1.0"?>\n<!--\n{lines}\n-->\n<robot name="{name}">\n'
            f'  <link name="{root}"/>\n{"".join(joints)}</robot>\n')


def _joint(name: str, parent: str, child: str, place: Sequence[float],
           rpy: Sequence[float]) -> str:
    """Return a link and its joint. place: m; rpy: degrees."""
    return f'''  <link name="{child}"/>
  <joint name="{name}_joint" type="fixed">
    <parent link="{parent}"/>
    <child link="{child}"/>
    <origin xyz="{' '.join(map(_number, place))}" rpy="{_radians(*rpy)}"/>
  </joint>
'''


def write_transform(found: NamedCamera) -> str:
    """Return the command that publishes the same as one transform, base_link to optical frame.

    Without a known height it has none, which a comment before it says. Raises ConfigError where
    the mounting is not known.
    """
    mount = mount_of(found)
    known = mount.height_m is not None
    return (('' if known else f'# the height above {BASE} is not known: add --z, in m\n')
            + _publisher(BASE, f'{_frame_name(found.name)}_optical_frame',
                         (0.0, 0.0, *[mount.height_m or 0.0] * known), mount.quaternion) + '\n')


def _publisher(parent: str, child: str, place: Sequence[float], turn: Sequence[float]) -> str:
    values = {**dict(zip('xyz', place, strict=False)),
              **dict(zip(('qx', 'qy', 'qz', 'qw'), turn, strict=True))}
    return ('ros2 run tf2_ros static_transform_publisher '
            + ' '.join(f'--{name} {_number(value)}' for name, value in values.items())
            + f' --frame-id {parent} --child-frame-id {child}')


def write_road(found: NamedCamera) -> str:
    """Return H.yaml of pictures without distortion: pixel to the road below the camera, m.

    Raises ConfigError where the mounting or the height is not known.
    """
    mount = mount_of(found)
    if mount.height_m is None:
        raise ConfigError('E-EXPORT-NO-HEIGHT',
                          f'{found.name} has no height of the camera above the road, without '
                          f'which nothing has a distance; calibrate with --speed, or with GPS')
    # of a point of the road in the camera's axes: ahead, left, and the camera's height below it
    to_camera = mount.rotation.T
    pixel_of = found.camera.matrix @ np.column_stack(
        [to_camera[:, 0], to_camera[:, 1], -mount.height_m * to_camera[:, 2]])
    road = np.linalg.inv(pixel_of)
    file = cv2.FileStorage('.yaml', cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    file.writeComment(f'of {found.name}, for pictures without distortion (export --to maps); x '
                      f'and y count from the road below the camera')
    file.write('H', road / road[2, 2] if abs(road[2, 2]) > 1e-9 else road)
    return str(file.releaseAndGetString())


def mount_of(found: NamedCamera) -> Mount:
    """Return the mounting. Raises ConfigError where it is not known."""
    if found.mount is None:
        raise ConfigError('E-EXPORT-NO-MOUNTING',
                          f'{found.name} does not say how the camera sits on the car; calibrate a '
                          f'drive that goes straight on, too, without --no-mount')
    return found.mount


def _frame_name(source: str) -> str:
    """Return what the frames' names begin with: front for front/result.json and front.yaml."""
    place = Path(source)
    stem = place.stem if place.suffix and place.stem not in UNNAMED else place.parent.name
    name = 'camera' if stem in UNNAMED else re.sub(r'\W', '_', stem, flags=re.ASCII)
    # no link is its own parent
    return f'{name}_camera' if f'{name}_link' == BASE else name


def _rpy(mount: Mount) -> tuple[float, float, float]:
    """Return roll, pitch and yaw about the fixed axes, as URDF has them, degrees."""
    return mount.roll_right_deg or 0.0, -mount.pitch_up_deg, mount.yaw_left_deg


def _angles(turn: Floats) -> tuple[float, float, float]:
    """Return the same of a rotation (3, 3)."""
    return (math.degrees(math.atan2(turn[2, 1], turn[2, 2])),
            math.degrees(math.asin(max(-1.0, min(1.0, -turn[2, 0])))),
            math.degrees(math.atan2(turn[1, 0], turn[0, 0])))


def _radians(*degrees: float) -> str:
    return ' '.join(_number(math.radians(each)) for each in degrees)


def _number(value: float) -> str:
    return f'{value:.9g}'


def _with_sigma(mount: Mount, name: str) -> str:
    value, sigma = getattr(mount, name), mount.sigma[name]
    if value is None or sigma is None:
        return 'not known, 0 is written'
    return f'{value:.3f}, standard deviation {sigma:.3f}'


def _in_comment(text: str) -> str:
    """Return a text without what no comment of XML may have."""
    return re.sub('-(?=-)', '- ', visible(text))
