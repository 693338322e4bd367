"""An accepted calibration as it is kept: whose it is, and whether it was edited or cannot be."""
from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from dashcalib_ros.camera import Camera, ros_camera
from dashcalib_ros.errors import InputError
from dashcalib_ros.judge import Calibration
from dashcalib_ros.limits import parse_yaml
from dashcalib_ros.report import NamedCamera, calibrated_camera, calibration_yaml
from dashcalib_ros.report.camera_file import parse_camera
from dashcalib_ros.report.camera_yaml import matrix_block, yaml_text

# of the width: 170 to 11 degrees across without distortion, or 570 as a fisheye
FOCAL = (0.1, 5.0)
# fy over fx: pixels of anamorphic pictures are up to twice as wide as high
ASPECT = (0.5, 2.0)
# of the picture beyond its border: the centre of a picture that was cropped
BESIDE = 0.5
# times the scale on the axis; no lens stretches the border of its picture more
STRETCH = 2.0
# of the way from the principal point to a corner
STEPS = 33
# in the block dashcalib, but not in its checksum
CHECKSUM, COUNT = 'checksum', 'contradictions'


@dataclass(frozen=True)
class Whose:
    """Which camera a node has: its name and the topic of its images.

    plain: the topic is image_raw, not remapped: all that a file of an older version can be of.
    """

    name: str
    topic: str
    plain: bool = True


@dataclass(frozen=True)
class Kept:
    """An accepted calibration: the camera, the frame its images were in, and the file's text.

    frame_id: None where the file does not say it. contradictions: how many calibrations in a row
    contradict it. edited: the text is not what a node wrote; then the camera's sigma is unknown.
    """

    camera: NamedCamera
    frame_id: str | None
    text: str
    contradictions: int = 0
    edited: bool = False

    @classmethod
    def of(cls, calibration: Calibration, whose: Whose, frame_id: str) -> Kept:
        """Make it of a calibration that was accepted just now."""
        now = datetime.now(timezone.utc).isoformat(timespec='seconds')
        document = yaml.safe_load(calibration_yaml(calibration, whose.name, now))
        own = document['dashcalib']
        own |= {'topic': whose.topic, 'frame_id': frame_id}
        own[CHECKSUM] = _checksum(document)
        return cls(calibrated_camera(calibration, whose.name), frame_id, yaml_text(document))

    @classmethod
    def read(cls, text: str, path: Path, whose: Whose) -> Kept:
        """Read a file's text; raises InputError unless it is of this node's camera.

        Whether it is plausible is not asked.
        """
        camera = parse_camera(text, path)
        if camera.verdict != 'accepted' or camera.sigma is None:
            raise InputError('it is no accepted calibration of this node; it is moved aside when '
                             'there is one')
        document = parse_yaml(text, str(path))
        own = document['dashcalib']
        name, topic = document.get('camera_name'), own.get('topic')
        if name != whose.name:
            raise InputError(f'it is of the camera {name}, this one is {whose.name}; it is moved '
                             f'aside when this one is calibrated')
        if topic != whose.topic and not (topic is None and whose.plain):
            of = f'of the images on {topic}' if topic else 'older and says no topic'
            raise InputError(f'it is {of}, this node has {whose.topic}; set camera_name to give '
                             f'each camera a file of its own')
        count, frame_id = own.get(COUNT, 0), own.get('frame_id')
        # an older file has neither
        older = topic is None and CHECKSUM not in own
        edited = not older and own.get(CHECKSUM) != _checksum(document)
        return cls(camera, None if frame_id is None else str(frame_id), text,
                   count if type(count) is int and count > 0 else 0, edited)

    def rectified(self, rectified: str) -> Kept:
        """Return it with the P of a setting, itself where the file has that already.

        P is no measurement but the user's choice: the present one counts, not the file's.
        """
        document = parse_yaml(self.text, self.camera.name)
        p = ros_camera(self.camera.camera, rectified).p
        before = document.get('projection_matrix')
        if isinstance(before, dict) and _equal(before.get('data'), p):
            return self
        document['projection_matrix'] = matrix_block(3, 4, p)
        return replace(self, text=yaml_text(document))

    def contradicted(self, times: int) -> Kept:
        """Return it with another number of contradictions in a row."""
        document = parse_yaml(self.text, self.camera.name)
        document['dashcalib'][COUNT] = times
        return replace(self, text=yaml_text(document), contradictions=times)


def implausible(kept: NamedCamera) -> str:
    """Return why no lens, or no solution, has such numbers; '' where one may."""
    camera, sigma = kept.camera, kept.sigma or {}
    width, height = camera.image_size
    if not FOCAL[0] <= camera.fx / width <= FOCAL[1]:
        return f'fx is {camera.fx:g} px in a picture {width} px wide'
    if not ASPECT[0] <= camera.fy / camera.fx <= ASPECT[1]:
        return f'fy is {camera.fy:g} px beside an fx of {camera.fx:g} px'
    if not (abs(camera.cx / width - 0.5) <= 0.5 + BESIDE
            and abs(camera.cy / height - 0.5) <= 0.5 + BESIDE):
        return f'the principal point ({camera.cx:g}, {camera.cy:g}) is far from the picture'
    if not _real(camera):
        return 'its distortion is none of a lens'
    bad = [name for name, value in sigma.items() if not (np.isfinite(value) and value > 0)]
    return f'the sigma of {", ".join(bad)} is not positive' if bad else ''


def _real(camera: Camera) -> bool:
    """Return whether a picture can be undistorted up to its corners, and is not torn apart."""
    width, height = camera.image_size
    corners = np.array([[x, y] for x in (0.0, width - 1.0) for y in (0.0, height - 1.0)])
    centre, focal = np.array([camera.cx, camera.cy]), np.array([camera.fx, camera.fy])
    with np.errstate(all='ignore'):
        pixels = centre + np.linspace(0, 1, STEPS)[:, None, None] * (corners - centre)
        rays = camera.rays(pixels)
        # what is seen beside the camera or behind it is not stretched by a pinhole's measure
        tangent = np.where(rays[..., 2] > 0, np.linalg.norm(rays[..., :2], axis=-1)
                           / rays[..., 2], np.inf)
        radius = np.linalg.norm((pixels - centre) / focal, axis=-1)
        stretch = np.diff(radius, axis=0) / np.diff(tangent, axis=0)
    return bool(np.isfinite(rays).all() and not (stretch > STRETCH).any())


def _checksum(document: dict[str, Any]) -> str:
    """Return that of what is published and of where it is from: of all but P and the count."""
    own = {key: value for key, value in document['dashcalib'].items()
           if key not in (CHECKSUM, COUNT)}
    content = {key: value for key, value in document.items() if key != 'projection_matrix'}
    try:
        text = json.dumps({**content, 'dashcalib': own}, sort_keys=True, default=str)
    except TypeError:  # keys that are no texts: no node writes these
        return ''
    return hashlib.sha256(text.encode()).hexdigest()


def _equal(data: Any, p: list[float]) -> bool:
    try:
        return bool(np.allclose(np.asarray(data, np.float64), p, rtol=1e-9, atol=0))
    except (TypeError, ValueError):
        return False
