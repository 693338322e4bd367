"""calibration.yaml: the file that camera_info_manager, usb_cam, v4l2_camera and others load.

Keys, order and layout are those that camera_calibration_parsers writes. Its parser looks keys up
by name, so it ignores our one extra block, dashcalib, which has sigma and provenance.

OpenCV's FileStorage reads the file, too. Version 4 wants the line %YAML; 4 and 5 want lists that
are indented, texts of 4096 characters at the most, and quotes: 4.2.1 is a broken number to them.
"""
from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import yaml

from dashcalib_ros.camera import Camera, ros_camera
from dashcalib_ros.camera.rectified import SAME
from dashcalib_ros.errors import ConfigError, shortened
from dashcalib_ros.judge import Calibration
from dashcalib_ros.report.result import plain_values

CAMERA_NAME = 'dashcam'
# OpenCV's limit is 4096, and an escaped character has up to ten
TEXT_LENGTH = 400


def calibration_yaml(calibration: Calibration, camera_name: str = CAMERA_NAME,
                     created: str | None = None, frame_id: str | None = None) -> str:
    """Return the YAML text of an accepted or weak calibration, at full precision.

    created: the time, as ISO 8601 text; without it, the same calibration gives the same text.
    frame_id: of the images, where it is known.
    Raises ConfigError for a camera name that the drivers would refuse, ValueError without
    intrinsics.
    """
    check_camera_name(camera_name)
    if calibration.camera is None or not np.isfinite(calibration.camera.params).all():
        raise ValueError('a calibration without finite intrinsics has no calibration.yaml')
    document = _document(calibration.camera, camera_name, calibration.config.rectified)
    own = _provenance(calibration, created)
    return yaml_text({**document, 'dashcalib': own if frame_id is None
                      else {**own, 'frame_id': frame_id}})


def camera_info_yaml(camera: Camera) -> str:
    """Return the YAML text of a camera alone, without a calibration's sigma and provenance."""
    return yaml_text(_document(camera, CAMERA_NAME, SAME))


def _document(camera: Camera, camera_name: str, rectified: str) -> dict[str, Any]:
    c = ros_camera(camera, rectified)
    width, height = camera.image_size
    return {
        'image_width': int(width),
        'image_height': int(height),
        'camera_name': camera_name,
        'camera_matrix': matrix_block(3, 3, c.k),
        'distortion_model': c.distortion_model,
        'distortion_coefficients': matrix_block(1, len(c.d), c.d),
        'rectification_matrix': matrix_block(3, 3, c.r),
        'projection_matrix': matrix_block(3, 4, c.p),
    }


def yaml_text(document: Mapping[str, Any]) -> str:
    """Return a camera_info document as text that ROS's parsers and OpenCV 4 and 5 read."""
    own = {key: _quoted(document[key]) for key in ('dashcalib',) if key in document}
    name = document.get('camera_name')
    if isinstance(name, str) and not name.isidentifier():  # OpenCV: 4k is a broken number
        own['camera_name'] = _Text(name)
    return str(yaml.dump({**document, **own}, Dumper=_Dumper, sort_keys=False,
                         default_flow_style=None, width=2**20, allow_unicode=True,
                         version=(1, 2)))


def check_camera_name(name: str) -> None:
    """Raise ConfigError for a name that camera_info_manager or image_pipeline would not take."""
    if not re.fullmatch(r'[A-Za-z0-9_]+', name):
        raise ConfigError(f'the camera name {name!r} must be letters, digits and underscores: '
                          'camera_info_manager takes no others')
    if name == 'narrow_stereo':
        raise ConfigError('the camera name narrow_stereo belongs to image_pipeline\'s stereo '
                          'files; choose another')


class _Text(str):
    """A text that is written with quotes."""


class _Dumper(yaml.SafeDumper):
    """Writes plain values, texts with quotes, and lists that are indented."""

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        super().increase_indent(flow, False)


_Dumper.add_representer(_Text, lambda dumper, text: dumper.represent_scalar(
    'tag:yaml.org,2002:str', str(text), style='"'))


def _quoted(value: Any) -> Any:
    """Return a value with every text in it, other than keys, as one that is written in quotes."""
    if isinstance(value, str):
        return _Text(shortened(value, TEXT_LENGTH))
    if isinstance(value, Mapping):
        return {key: _quoted(each) for key, each in value.items()}
    return [_quoted(each) for each in value] if isinstance(value, (list, tuple)) else value


def matrix_block(rows: int, cols: int, data: Sequence[float]) -> dict[str, Any]:
    """Return a matrix as the document has it."""
    # dt: OpenCV reads the matrix by it, as doubles; the other readers look up what they know
    return {'rows': rows, 'cols': cols, 'dt': 'd', 'data': [float(value) for value in data]}


def _provenance(calibration: Calibration, created: str | None) -> dict[str, Any]:
    block: dict[str, Any] = plain_values({
        'verdict': calibration.verdict.level,
        'reasons': calibration.verdict.reasons,
        'camera_model': None if calibration.camera is None else calibration.camera.model,
        'sigma': calibration.sigma,
        'turns_used': calibration.turns_used,
        'reprojection_error_px': calibration.reprojection_error_px,
        'input': calibration.input_name,
        'seed': calibration.config.seed,
        'versions': calibration.versions,
        **({} if calibration.mount is None else {'mount': calibration.mount}),
    })
    return block if created is None else {**block, 'created': created}
