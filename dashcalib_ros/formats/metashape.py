# SPDX-License-Identifier: Apache-2.0
"""Metashape's calibration XML, and the calibrations in its cameras.xml.

The centre counts from the picture's middle, with the corner of the first pixel at (0, 0); p1 and
p2 are OpenCV's p2 and p1; b1 is what fx has more than fy.
"""
from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from functools import partial
from pathlib import Path
from xml.etree.ElementTree import Element

from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.camera import HALF_PIXEL
from dashcalib_ros.camera.other import OtherLens, angles, bent, plane, undone
from dashcalib_ros.errors import InputError
from dashcalib_ros.formats.values import (
    EQUIDISTANT,
    PLUMB_BOB,
    Cameras,
    camera_with,
    distortion_model,
    is_fisheye,
    named_coefficients,
    numbers_in,
    read_number,
    read_size,
    xml_root,
)
from dashcalib_ros.judge.difference import NamedCamera

MODELS = {'frame': PLUMB_BOB, 'fisheye': EQUIDISTANT, 'equidistant_fisheye': EQUIDISTANT}


def cameras(text: str, path: Path) -> Cameras:
    """Return the cameras of either file; see formats/table.py."""
    if not text.lstrip().startswith('<') or '<calibration' not in text:
        return {}
    root = xml_root(text, path)
    sensors = {each.get('label') or str(number): each
               for number, each in enumerate(root.iter('sensor'))} or {'': root}
    # the adjusted one comes after the initial one
    found = {name: [each for each in sensor.iter('calibration') if each.find('f') is not None]
             for name, sensor in sensors.items()}
    return {name: partial(_read, each[-1], path) for name, each in found.items() if each}


def _read(node: Element, path: Path) -> Camera | OtherLens:
    name = node.get('type') or node.findtext('projection')
    kind = distortion_model(MODELS, name, 'the projection', path)
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


def write(found: NamedCamera) -> str:
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
