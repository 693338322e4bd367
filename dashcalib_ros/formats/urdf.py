# SPDX-License-Identifier: Apache-2.0
"""How the camera sits on the car: as URDF, as a static transform, and as VisionPilot's H.yaml.

None is read. H maps a pixel to the road: metres ahead and to the left.
"""
from __future__ import annotations

import math
import re
from pathlib import Path

import cv2
import numpy as np

from dashcalib_ros.errors import ConfigError, visible
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
    mount, name = _mount_of(found), _frame_name(found.name)
    about = [
        f'{found.name}: how the camera sits on the car, {mount.verdict}', *mount.reasons,
        *(f'{what}: {_with_sigma(mount, key)}' for key, what in WRITTEN.items()),
        f'x and y are not known: {BASE} is on the road below the camera until you set them']
    # no comment of XML may have two hyphens
    lines = '\n'.join(f'  {re.sub("-(?=-)", "- ", visible(each))}' for each in about)
    # about the fixed axes, as URDF has them
    rpy = _radians(mount.roll_right_deg or 0.0, -mount.pitch_up_deg, mount.yaw_left_deg)
    return f'''<?xml version="1.0"?>
<!--
{lines}
-->
<robot name="{name}">
  <link name="{BASE}"/>
  <link name="{name}_link"/>
  <joint name="{name}_joint" type="fixed">
    <parent link="{BASE}"/>
    <child link="{name}_link"/>
    <origin xyz="0 0 {_number(mount.height_m or 0.0)}" rpy="{rpy}"/>
  </joint>
  <link name="{name}_optical_frame"/>
  <joint name="{name}_optical_joint" type="fixed">
    <parent link="{name}_link"/>
    <child link="{name}_optical_frame"/>
    <origin xyz="0 0 0" rpy="{_radians(*OPTICAL_RPY)}"/>
  </joint>
</robot>
'''


def write_transform(found: NamedCamera) -> str:
    """Return the command that publishes the same as one transform, base_link to optical frame.

    Without a known height it has none, which a comment before it says. Raises ConfigError where
    the mounting is not known.
    """
    mount = _mount_of(found)
    turn = ' '.join(f'--q{axis} {_number(value)}'
                    for axis, value in zip('xyzw', mount.quaternion, strict=True))
    known = mount.height_m is not None
    return (('' if known else f'# the height above {BASE} is not known: add --z, in m\n')
            + f'ros2 run tf2_ros static_transform_publisher --x 0 --y 0 '
            f'{f"--z {_number(mount.height_m or 0.0)} " if known else ""}{turn} '
            f'--frame-id {BASE} --child-frame-id {_frame_name(found.name)}_optical_frame\n')


def write_road(found: NamedCamera) -> str:
    """Return H.yaml of pictures without distortion: pixel to the road below the camera, m.

    Raises ConfigError where the mounting or the height is not known.
    """
    mount = _mount_of(found)
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


def _mount_of(found: NamedCamera) -> Mount:
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


def _radians(*degrees: float) -> str:
    return ' '.join(_number(math.radians(each)) for each in degrees)


def _number(value: float) -> str:
    return f'{value:.9g}'


def _with_sigma(mount: Mount, name: str) -> str:
    value, sigma = getattr(mount, name), mount.sigma[name]
    if value is None or sigma is None:
        return 'not known, 0 is written'
    return f'{value:.3f}, standard deviation {sigma:.3f}'
