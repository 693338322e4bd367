# SPDX-License-Identifier: Apache-2.0
"""KITTI's calib_cam_to_cam.txt, and the calib.txt of its odometry: a name and numbers a line.

A camera has two kinds of pictures, raw and rectified ones, of different sizes; those that are
published as synchronised and all of the odometry are rectified, and have the K of P.
"""
from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

from dashcalib_ros.camera import Camera
from dashcalib_ros.errors import InputError
from dashcalib_ros.formats.values import (
    PLUMB_BOB,
    Cameras,
    Read,
    Sizeless,
    camera_with,
    focal_and_centre,
    numbers_in,
    pinhole,
)

Lines = dict[str, list[float]]
COUNTS = {'S': 2, 'K': 9, 'D': 5, 'P': 12}


def cameras(text: str, path: Path) -> Cameras:
    """Return the cameras of either file; see formats/table.py."""
    lines: Lines = {}
    for line in text.splitlines():
        if found := re.fullmatch(r'(P\d|(?:[SKDP]_(?:rect_)?)\d\d):(.*)', line.strip()):
            lines[found[1]] = numbers_in(found[2]) or []
    for name, values in lines.items():
        if len(values) != COUNTS[name[0]]:
            raise InputError('E-CALIBRATION-COUNT',
                             f'{path}: {name} must have {COUNTS[name[0]]} numbers, and has '
                             f'{len(values)}')
    numbers = [name[2:] for name in lines if re.fullmatch(r'K_\d\d', name)]
    raw = {number: partial(_raw, lines, number, path) for number in numbers
           if {f'D_{number}', f'S_{number}'} <= lines.keys()}
    rectified = {number: partial(_rectified, lines, number, path) for number in raw
                 if {f'P_rect_{number}', f'S_rect_{number}'} <= lines.keys()}
    return {
        **{name: partial(_pinhole, values, path) for name, values in lines.items()
           if re.fullmatch(r'P\d', name)},
        **{number: partial(_either, lines, number, raw[number], rectified[number], path)
           if number in rectified else raw[number] for number in raw},
        **{f'raw_{number}': read for number, read in raw.items() if number in rectified},
        **{f'rect_{number}': read for number, read in rectified.items()}}


def _raw(lines: Lines, number: str, path: Path) -> Camera:
    return camera_with(lines[f'S_{number}'], focal_and_centre(lines[f'K_{number}']), PLUMB_BOB,
                       lines[f'D_{number}'], path)


def _rectified(lines: Lines, number: str, path: Path) -> Camera:
    return camera_with(lines[f'S_rect_{number}'], _view(lines[f'P_rect_{number}']), PLUMB_BOB, (),
                       path)


def _view(p: list[float]) -> list[float]:
    """Return fx, fy, cx, cy of P (12,); its last column is the distance to the first camera."""
    return focal_and_centre([*p[:3], *p[4:7], *p[8:11]])


def _pinhole(p: list[float], path: Path) -> Sizeless:
    return pinhole([*p[:3], *p[4:7], *p[8:11]], path)


def _either(lines: Lines, number: str, raw: Callable[[], Camera],
            rectified: Callable[[], Camera], path: Path) -> Read:
    def of(size: tuple[int, int]) -> Camera:
        return (rectified if list(size) == lines[f'S_rect_{number}'] else raw)()
    return Sizeless(of, f'write rect_{number} for rectified pictures, raw_{number} for others')
