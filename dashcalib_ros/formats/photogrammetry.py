# SPDX-License-Identifier: Apache-2.0
"""The camera files of programs that reconstruct from pictures: Metashape, OpenSfM, nerfstudio.

nerfstudio counts pixels from the first one's corner. OpenSfM counts from the picture's middle, in
units of its longer side. In Metashape's XML the centre counts from the picture's middle, with the
corner of the first pixel at (0, 0); p1 and p2 are OpenCV's p2 and p1; b1 is what fx has more than
fy.
"""
from __future__ import annotations

import json
import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.camera import HALF_PIXEL
from dashcalib_ros.camera.other import OtherLens, angles, bent, plane, undone
from dashcalib_ros.camera.rotation import OPTICAL
from dashcalib_ros.errors import ConfigError, InputError
from dashcalib_ros.formats import colmap
from dashcalib_ros.formats.values import (
    EQUIDISTANT,
    PLUMB_BOB,
    Cameras,
    Data,
    Placed,
    camera_with,
    distortion_model,
    is_fisheye,
    named_coefficients,
    numbers_in,
    read_coefficients,
    read_number,
    read_size,
    with_lenses,
    xml_root,
)
from dashcalib_ros.judge.difference import NamedCamera

METASHAPE = {'frame': PLUMB_BOB, 'fisheye': EQUIDISTANT, 'equidistant_fisheye': EQUIDISTANT}
OPENSFM = {'perspective': PLUMB_BOB, 'simple_radial': PLUMB_BOB, 'radial': PLUMB_BOB,
           'brown': PLUMB_BOB, 'fisheye': EQUIDISTANT, 'fisheye_opencv': EQUIDISTANT}
# COLMAP's first ones, by their names
NERFSTUDIO = {name: kind for name, _, kind, _ in colmap.MODELS[:6] if kind}


def metashape(text: str, path: Path) -> Cameras:
    """Return the camera of a calibration XML, or those of cameras.xml; see formats/table.py."""
    if not text.lstrip().startswith('<') or '<calibration' not in text:
        return {}
    root = xml_root(text, path)
    sensors = {each.get('label') or str(number): each
               for number, each in enumerate(root.iter('sensor'))} or {'': root}
    # the adjusted one comes after the initial one
    found = {name: [each for each in sensor.iter('calibration') if each.find('f') is not None]
             for name, sensor in sensors.items()}
    return {name: partial(_metashape, each[-1], path) for name, each in found.items() if each}


def _metashape(node: Element, path: Path) -> Camera | OtherLens:
    name = node.get('type') or node.findtext('projection')
    kind = distortion_model(METASHAPE, name, 'the projection', path)
    # read_number() takes texts
    given = {each.tag: each.text for each in node}
    resolution = node.find('resolution')
    sides = given if resolution is None else resolution.attrib
    width, height = read_size(*(next(iter(numbers_in(sides.get(key) or '') or ()), None)
                                for key in ('width', 'height')), path=path)
    f, cx, cy, b1, b2, *radial = (
        read_number(given, key, path, None if key == 'f' else 0.0)
        for key in ('f', 'cx', 'cy', 'b1', 'b2', 'k1', 'k2', 'k3', 'k4'))
    p1, p2, p3, p4 = (read_number(given, key, path, 0.0) for key in ('p1', 'p2', 'p3', 'p4'))
    if b2 or p3 or p4:
        raise InputError('E-CAMERA-SKEW',
                         f'{path} has b2, p3 or p4, which no supported model has; optimise the '
                         f'cameras without them')
    view = [f + b1, f, width / 2 + cx - HALF_PIXEL, height / 2 + cy - HALF_PIXEL]
    if kind == EQUIDISTANT and not (p1 or p2):
        return camera_with((width, height), view, kind, radial, path)
    if kind == PLUMB_BOB and not radial[3]:
        return camera_with((width, height), view, kind, [*radial[:2], p2, p1, radial[2]], path)
    return OtherLens(f'{name} with k4, p1, p2', (width, height), view,
                     undone(bent(radial, (p2, p1)), plane if kind == PLUMB_BOB else angles))


def write_metashape(found: NamedCamera) -> str:
    """Return a calibration XML. Raises ConfigError."""
    camera, (width, height) = found.camera, found.image_size
    named = named_coefficients(camera, 5, 'metashape')
    if not is_fisheye(camera):
        named['p1'], named['p2'] = named['p2'], named['p1']
    root = ElementTree.Element('calibration')
    for key, value in {
            'projection': 'fisheye' if is_fisheye(camera) else 'frame',
            'width': width, 'height': height, 'f': float(camera.fy),
            'cx': float(camera.cx + HALF_PIXEL - width / 2),
            'cy': float(camera.cy + HALF_PIXEL - height / 2),
            'b1': float(camera.fx - camera.fy),
            **{name: float(value) for name, value in named.items() if value}}.items():
        ElementTree.SubElement(root, key).text = str(value)
    ElementTree.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ElementTree.tostring(root, "unicode")}\n'


def opensfm(data: Any, path: Path) -> Cameras:
    """Return the cameras of camera_models.json or reconstruction.json; see formats/table.py."""
    if isinstance(data, list) and data and isinstance(data[0], dict):
        data = data[0].get('cameras')  # reconstruction.json
    return {str(name): partial(_opensfm, each, path)
            for name, each in (data.items() if isinstance(data, dict) else ())
            if isinstance(each, dict) and 'projection_type' in each}


def _opensfm(data: Data, path: Path) -> Camera:
    kind = distortion_model(OPENSFM, data['projection_type'], 'the projection_type', path)
    size = read_size(data.get('width'), data.get('height'), path=path)
    longer = max(size)
    # one focal length, or two
    fx, fy = (longer * read_number(data, key if key in data else 'focal', path)
              for key in ('focal_x', 'focal_y'))
    cx, cy = (longer * read_number(data, key, path, 0.0) + side / 2 - HALF_PIXEL
              for key, side in zip(('c_x', 'c_y'), size, strict=True))
    return camera_with(size, [fx, fy, cx, cy], kind, read_coefficients(data, kind, path), path)


def write_opensfm(found: NamedCamera) -> str:
    """Return a camera_models.json. Raises ConfigError."""
    camera, (width, height) = found.camera, found.image_size
    longer = max(width, height)
    kind = 'fisheye_opencv' if is_fisheye(camera) else 'brown'
    return json.dumps({f'v2 dashcam {width} {height} {kind} 0': {
        'projection_type': kind, 'width': width, 'height': height,
        'focal_x': camera.fx / longer, 'focal_y': camera.fy / longer,
        'c_x': (camera.cx + HALF_PIXEL - width / 2) / longer,
        'c_y': (camera.cy + HALF_PIXEL - height / 2) / longer,
        **named_coefficients(camera, 5, 'opensfm')}}, indent=2) + '\n'


def nerfstudio(data: Any, path: Path) -> Cameras:
    """Return the camera of all frames of transforms.json, or of each; see formats/table.py."""
    if not isinstance(data, dict):
        return {}
    if {'fl_x', 'camera_angle_x'} & data.keys():
        return {'': partial(_nerfstudio, data, path)}
    frames = data.get('frames')
    return {str(frame.get('file_path', number)): partial(_nerfstudio, {**data, **frame}, path)
            for number, frame in enumerate(frames if isinstance(frames, list) else [])
            if isinstance(frame, dict)}


def _nerfstudio(data: Data, path: Path) -> Camera:
    name = 'OPENCV_FISHEYE' if data.get('is_fisheye') else data.get('camera_model', 'OPENCV')
    kind = distortion_model(NERFSTUDIO, name, 'the camera_model', path)
    width, height = read_size(data.get('w'), data.get('h'), path=path)
    if 'fl_x' in data:
        fx = read_number(data, 'fl_x', path)
    else:
        fx = width / 2 / math.tan(read_number(data, 'camera_angle_x', path) / 2)
    view = [fx, read_number(data, 'fl_y', path, fx),
            read_number(data, 'cx', path, width / 2) - HALF_PIXEL,
            read_number(data, 'cy', path, height / 2) - HALF_PIXEL]
    return camera_with((width, height), view, kind, read_coefficients(data, kind, path), path)


def write_nerfstudio(found: NamedCamera) -> str:
    """Return the camera's part of a transforms.json; the frames are to be added.

    Raises ConfigError.
    """
    return json.dumps({**_nerf_model(found.camera), **_nerf_content(found.camera), 'frames': []},
                      indent=2) + '\n'


def write_nerfstudio_rig(rig: Sequence[Placed]) -> str:
    """Return a transforms.json with a frame of each camera of a rig, which are to be repeated.

    Its world is the car as the base sees it: x ahead, y to the left, z upwards. Raises ConfigError
    for fisheyes among other lenses, which it cannot have.
    """
    found = with_lenses(rig, 'nerfstudio')
    model = _nerf_model(found[0][1])
    if any(_nerf_model(camera) != model for _, camera in found):
        raise ConfigError('E-RIG-MIXED', 'nerfstudio has one kind of lens for all cameras; use '
                                         'rig_config.json')
    turn = np.eye(4)
    turn[:3, :3] = next((each.mount.rotation for each in rig if each.mount), OPTICAL)
    return json.dumps({**model, 'frames': [{
        'file_path': f'{each.name}/', **_nerf_content(camera),
        # of a camera that looks along -z, y upwards
        'transform_matrix': (turn @ np.linalg.inv(each.pose) @ np.diag(
            [1.0, -1.0, -1.0, 1.0])).tolist()} for each, camera in found]}, indent=2) + '\n'


def _nerf_model(camera: Camera) -> dict[str, str]:
    return {'camera_model': 'OPENCV_FISHEYE' if is_fisheye(camera) else 'OPENCV'}


def _nerf_content(camera: Camera) -> dict[str, float]:
    width, height = camera.image_size
    return {'w': width, 'h': height,
            'fl_x': camera.fx, 'fl_y': camera.fy, 'cx': camera.cx + HALF_PIXEL,
            'cy': camera.cy + HALF_PIXEL, **named_coefficients(camera, 5, 'nerfstudio')}
