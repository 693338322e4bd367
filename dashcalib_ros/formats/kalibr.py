# SPDX-License-Identifier: Apache-2.0
"""Kalibr's camchain.yaml, and OpenVINS's, which cv2.FileStorage reads."""
from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from dashcalib_ros.camera import NO_DISTORTION, Camera
from dashcalib_ros.camera.other import (
    OtherLens,
    Places,
    bent,
    double_sphere,
    extended_unified,
    field_of_view,
    omni,
    undone,
)
from dashcalib_ros.errors import InputError, shortened
from dashcalib_ros.formats.ros import Indented
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
    read_numbers,
    read_pair,
    read_size,
    with_lenses,
)
from dashcalib_ros.judge.difference import NamedCamera

KEY = 'distortion_coeffs'
PINHOLE, OMNI, DS, EUCM, FOV = 'pinhole', 'omni', 'ds', 'eucm', 'fov'
# what comes before fx, fy, cx, cy
FIRST = {PINHOLE: 0, OMNI: 1, DS: 2, EUCM: 2}
LIFTS: Mapping[str, Callable[..., Places]] = {
    OMNI: omni, DS: double_sphere, EUCM: extended_unified}
MODELS = {'radtan': PLUMB_BOB, 'equidistant': EQUIDISTANT, 'equi': EQUIDISTANT,
          **dict.fromkeys(NO_DISTORTION, PLUMB_BOB)}


def cameras(data: Any, path: Path) -> Cameras:
    """Return the cameras of a camchain, or of a part with one camera; see formats/table.py."""
    if not isinstance(data, dict):
        return {}
    if KEY in data:
        return {'': partial(_read, data, path)}
    return {str(name): partial(_read, each, path) for name, each in data.items()
            if isinstance(each, dict) and KEY in each}


def results(text: str, path: Path) -> Cameras:
    """Refuse the text of results that Kalibr writes beside a camchain; see formats/table.py."""
    if re.search(r'^\s*projection: \[.*\+-', text, re.MULTILINE):
        raise InputError('E-KALIBR-RESULTS',
                         f'{path} has the results of Kalibr in words, without the size of the '
                         f'pictures; use the camchain YAML that Kalibr wrote beside it')
    return {}


def _read(data: Data, path: Path) -> Camera | OtherLens:
    model = data.get('camera_model', PINHOLE)
    if model not in FIRST:
        raise InputError('E-LENS-MODEL',
                         f'{path} has the camera model {shortened(repr(model))}; '
                         f'calibrate with --models pinhole-radtan, or pinhole-equi')
    size, d = read_pair(data, 'resolution', path), read_numbers(data[KEY], KEY, path)
    values = read_numbers(data.get('intrinsics'), 'intrinsics', path, 4 + FIRST[model])
    first, view, name = values[:-4], values[-4:], data.get('distortion_model')
    if model == PINHOLE and name == FOV:
        return OtherLens(FOV, read_size(*size, path=path), view, field_of_view(*d[:1] or [0.0]))
    kind = distortion_model(MODELS, name, 'the distortion model', path)
    if model == PINHOLE:
        return camera_with(size, view, kind, d, path)
    if any(d) and kind != PLUMB_BOB:
        raise InputError('E-LENS-MODEL',
                         f'{path} has {model} with {name}, which Kalibr does not calibrate; use '
                         f'its own file')
    return OtherLens(model, read_size(*size, path=path), view,
                     undone(bent(d[:2], (d[2], d[3])), LIFTS[model](*first)) if any(d) else
                     LIFTS[model](*first))


def write(found: NamedCamera) -> str:
    """Return a camchain.yaml with one camera. Raises ConfigError."""
    return str(yaml.safe_dump({'cam0': _content(found.camera)}, sort_keys=False,
                              default_flow_style=None))


def write_openvins(found: NamedCamera) -> str:
    """Return OpenVINS's kalibr_imucam_chain.yaml, whose T_imu_cam is to be set.

    Raises ConfigError.
    """
    pose = [[float(row == column) for column in range(4)] for row in range(4)]
    content = yaml.dump({'cam0': {'T_imu_cam': pose, **_content(found.camera)}}, Dumper=Indented,
                        sort_keys=False, default_flow_style=None, width=2**20)
    return f'%YAML:1.0\n---\n{content}'


def write_rig(rig: Sequence[Placed]) -> str:
    """Return a camchain.yaml of the cameras of a rig. Raises ConfigError."""
    cameras, last, head = {}, np.eye(4), '# T_cn_cnm1: from the camera before\n'
    for number, (each, camera) in enumerate(with_lenses(rig, 'kalibr')):
        content = _content(camera, f'/{each.name}/image_raw')
        if number:
            content['T_cn_cnm1'] = (each.pose @ np.linalg.inv(last)).tolist()
        if each.translation_m is None:
            head += f'# {each.name}: no metres are known, 0 is written\n'
        cameras[f'cam{number}'], last = content, each.pose
    return head + str(yaml.safe_dump(cameras, sort_keys=False, default_flow_style=None))


def _content(camera: Camera, topic: str = '/image_raw') -> dict[str, Any]:
    return {
        'camera_model': 'pinhole',
        'intrinsics': [camera.fx, camera.fy, camera.cx, camera.cy],
        'distortion_model': 'equidistant' if is_fisheye(camera) else 'radtan',
        'distortion_coeffs': list(named_coefficients(camera, 4, 'kalibr').values()),
        'resolution': list(camera.image_size),
        'rostopic': topic}
