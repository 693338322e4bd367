# SPDX-License-Identifier: Apache-2.0
"""ROS's camera_info: the YAML and INI files of camera_calibration_parsers, and messages.

Autoware's and Foxglove's are the same in other words, and are only written here.

The YAML is what camera_info_manager, usb_cam, v4l2_camera and others load. Keys, order and layout
are those that camera_calibration_parsers writes. OpenCV's FileStorage reads the file, too. Version
4 wants the line %YAML; 4 and 5 want lists that are indented, texts of at most 4096 characters,
and quotes: 4.2.1 is a broken number to them.
"""
from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from dashcalib_ros.camera import Camera, ros_camera, ros_faults
from dashcalib_ros.camera.other import OtherLens
from dashcalib_ros.camera.remap import SAME
from dashcalib_ros.errors import ConfigError, InputError, shortened
from dashcalib_ros.formats import opencv, plain
from dashcalib_ros.formats.plausible import doubts
from dashcalib_ros.formats.values import (
    Cameras,
    Data,
    camera_with,
    focal_and_centre,
    is_fisheye,
    numbers_in,
    pinhole_only,
    read_number,
)
from dashcalib_ros.input.bag_write import first_camera_info
from dashcalib_ros.judge.difference import NamedCamera

CAMERA_NAME = 'dashcam'
# our own block in the file; the parsers look keys up by name, and so ignore it
OWN = 'dashcalib'
# the section of an INI file that is not a camera
INI_IMAGE = 'image'
# OpenCV's limit is 4096, and an escaped character has up to ten
TEXT_LENGTH = 400


def camera_of_bag(path: Path, topic: str | None) -> NamedCamera:
    """Return the camera of a bag's camera_info; topic: as first_camera_info()'s."""
    found, message = first_camera_info(path, topic)
    return camera_of_message(message, f'{path}:{found}')


def camera_of_message(message: Any, name: str) -> NamedCamera:
    """Return the camera of a CameraInfo of ROS 1 or 2. Raises InputError where there is none."""
    k, d, r, p = ([float(value) for value in getattr(message, key,
                                                     getattr(message, key.upper(), ()))]
                  for key in 'kdrp')
    size, roi = (int(message.width), int(message.height)), message.roi
    _check_whole(size, (message.binning_x, message.binning_y),
                 (roi.x_offset, roi.y_offset, roi.width, roi.height), name)
    if not k or not k[0] > 0:
        raise InputError('E-CALIBRATION-EMPTY',
                         f'{name} is uncalibrated: K[0] is not positive; load a calibration into '
                         f'the driver')
    if not np.isfinite([*k, *d, *r, *p]).all():
        raise InputError('E-CALIBRATION-NUMBER',
                         f'{name} has numbers that are not finite; calibrate the camera again')
    camera = camera_with(size, focal_and_centre(k), str(message.distortion_model), d, name)
    return NamedCamera(name, camera, faults=ros_faults(camera, k, r, p),
                       warnings=doubts(camera, name))


def echoed_cameras(data: Any, path: Path) -> Cameras:
    """Return the camera of a CameraInfo that `ros2 topic echo` wrote; see formats/table.py."""
    known = opencv.has_matrix(data) and opencv.Entries(data, path).key('binningx', 'roi')
    return {'': partial(_read_echoed, data, path)} if known else {}


def _read_echoed(data: Data, path: Path) -> NamedCamera | OtherLens:
    entries = opencv.Entries(data, path)
    part = entries.first('roi')
    part = part if isinstance(part, dict) else {}
    found = opencv.read(data, path, (*opencv.RECTIFICATION, 'r'), (*opencv.PROJECTION, 'p'))
    _check_whole(found.image_size,
                 [read_number(data, entries.key(key) or '', path, 0.0)
                  for key in ('binningx', 'binningy')],
                 [read_number(part, key, path, 0.0)
                  for key in ('x_offset', 'y_offset', 'width', 'height')], path)
    return found


def _check_whole(size: tuple[int, int], binning: Sequence[float], roi: Sequence[float],
                 name: str | Path) -> None:
    """Raise InputError for a part of the sensor, or binning. roi: x, y, width, height."""
    if tuple(roi) not in ((0, 0, 0, 0), (0, 0, *size)) or max(binning) > 1:
        raise InputError('E-CALIBRATION-PART',
                         f'{name} has binning or a region of interest: use the calibration of the '
                         f'images as they are')


def ini_cameras(text: str, path: Path) -> Cameras:
    """Return the cameras of an INI file: ROS's, a line of words, then its numbers; or fx = 700.

    See formats/table.py.
    """
    if not re.search(r'^\s*\[[^\[\]{}",]+\]\s*$', text, re.MULTILINE):
        return {}
    sections: dict[str, dict[str, Any]] = {}
    section: dict[str, Any] = {}
    values: list[float] = []
    for line in (re.sub('[#;].*', '', line).strip() for line in text.splitlines()):
        key, sign, value = (part.strip() for part in (line.partition('=') if '=' in line else
                                                      line.partition(':')))
        numbers = numbers_in(line)
        if line.startswith('[') and line.endswith(']'):
            section = sections.setdefault(line[1:-1].strip(), {})
        elif sign:
            section[key] = numbers_in(value) or value
        elif numbers is None:
            section[line] = values = []
        else:
            values += numbers
    if INI_IMAGE not in sections:
        return plain.cameras({name: {key: value[0] if len(value) == 1 else value
                                     for key, value in each.items()}
                              for name, each in sections.items()}, path)
    image = {key: values[0] for key, values in sections.pop(INI_IMAGE).items() if values}
    return {name: partial(opencv.read, {**image, **section}, path)
            for name, section in sections.items()}


def write(found: NamedCamera) -> str:
    """Return the YAML of a camera alone, without a calibration's sigma and provenance."""
    return yaml_text(document(found.camera))


def write_autoware(found: NamedCamera) -> str:
    """Return it as Autoware's CalibrationTools does. Raises ConfigError for a fisheye."""
    pinhole_only(found.camera, 'autoware')
    return write(found)


def write_foxglove(found: NamedCamera) -> str:
    """Return Foxglove's CameraCalibration as JSON, where a fisheye is kannala_brandt."""
    ros = ros_camera(found.camera)
    return json.dumps({
        'timestamp': {'sec': 0, 'nsec': 0}, 'frame_id': 'camera',
        'width': ros.width, 'height': ros.height,
        'distortion_model': ('kannala_brandt' if is_fisheye(found.camera)
                             else ros.distortion_model),
        'D': ros.d, 'K': ros.k, 'R': ros.r, 'P': ros.p}, indent=2) + '\n'


def document(camera: Camera, camera_name: str = CAMERA_NAME, rectified: str = SAME
             ) -> dict[str, Any]:
    """Return the content of the YAML; rectified: as ros_camera()'s."""
    c = ros_camera(camera, rectified)
    return {
        'image_width': int(c.width),
        'image_height': int(c.height),
        'camera_name': camera_name,
        'camera_matrix': matrix_block(3, 3, c.k),
        'distortion_model': c.distortion_model,
        'distortion_coefficients': matrix_block(1, len(c.d), c.d),
        'rectification_matrix': matrix_block(3, 3, c.r),
        'projection_matrix': matrix_block(3, 4, c.p),
    }


def matrix_block(rows: int, cols: int, data: Sequence[float]) -> dict[str, Any]:
    """Return a matrix as the document has it."""
    # dt: OpenCV reads the matrix by it, as doubles; the other readers look up what they know
    return {'rows': rows, 'cols': cols, 'dt': 'd', 'data': [float(value) for value in data]}


def yaml_text(content: Mapping[str, Any]) -> str:
    """Return a document as text that ROS's parsers and OpenCV 4 and 5 read."""
    own = {key: _quoted(content[key]) for key in (OWN,) if key in content}
    name = content.get('camera_name')
    if isinstance(name, str) and not name.isidentifier():  # OpenCV: 4k is a broken number
        own['camera_name'] = _Text(name)
    return str(yaml.dump({**content, **own}, Dumper=Indented, sort_keys=False,
                         default_flow_style=None, width=2**20, allow_unicode=True,
                         version=(1, 2)))


def check_camera_name(name: str) -> None:
    """Raise ConfigError for a name that camera_info_manager or image_pipeline would not take."""
    if not re.fullmatch(r'[A-Za-z0-9_]+', name):
        raise ConfigError('E-CAMERA-NAME',
                          f'the camera name {name!r} may have only letters, digits and '
                          'underscores: camera_info_manager refuses others')
    if name == 'narrow_stereo':
        raise ConfigError('E-CAMERA-NAME-TAKEN', 'the camera name narrow_stereo belongs to the '
                          'stereo files of image_pipeline; choose another one')


class _Text(str):
    """A text that is written with quotes."""


class Indented(yaml.SafeDumper):
    """Writes plain values, texts with quotes, and lists that are indented."""

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        """Indent a list below its key, too."""
        super().increase_indent(flow, False)


Indented.add_representer(_Text, lambda dumper, text: dumper.represent_scalar(
    'tag:yaml.org,2002:str', str(text), style='"'))


def _quoted(value: Any) -> Any:
    """Return a value with every text in it, other than keys, as one that is written in quotes."""
    if isinstance(value, str):
        return _Text(shortened(value, TEXT_LENGTH))
    if isinstance(value, Mapping):
        return {key: _quoted(each) for key, each in value.items()}
    return [_quoted(each) for each in value] if isinstance(value, (list, tuple)) else value
