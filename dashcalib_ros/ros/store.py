# SPDX-License-Identifier: Apache-2.0
"""The accepted calibration on disk: where, whose, and whether it was edited or cannot be."""
from __future__ import annotations

import fcntl
import hashlib
import json
import os
import re
import stat
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import yaml

from dashcalib_ros.camera import Camera, ros_camera
from dashcalib_ros.errors import InputError, OutputError
from dashcalib_ros.formats import calibrated_camera, calibration_yaml
from dashcalib_ros.formats.load import parse_camera
from dashcalib_ros.formats.ros import matrix_block, yaml_text
from dashcalib_ros.judge.calibration import Mount
from dashcalib_ros.limits import YAML_BYTES, parse_yaml, read_text
from dashcalib_ros.report import Calibration, NamedCamera, set_aside, write_text
from dashcalib_ros.whole_files import prepared, remove_leftovers

# camera_info_manager's; its Python port is not used, as it reads no file under ROS 2: it sets
# CameraInfo.K, which is k there (image_common issue 354)
DEFAULT = 'file://${ROS_HOME}/camera_info/${NAME}.yaml'
KNOWN = 'file:///folder/camera.yaml, package://package/folder/camera.yaml, or a path'
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
# of the reader, for numbers with which nothing can be computed: formats/plausible.py
NO_LENS = frozenset(f'E-CALIBRATION-{each}' for each in (
    'ASPECT', 'CENTRE', 'EMPTY', 'EXCHANGED', 'FOCAL', 'LENS', 'NO-RAY', 'OTHER-SIZE'))
# in the block dashcalib, but not in its checksum
CHECKSUM, COUNT = 'checksum', 'contradictions'


@dataclass(frozen=True)
class CameraIdentity:
    """Which camera a node has: its name and the topic of its images.

    plain: the topic is image_raw, not remapped: all that a file of an older version can be of.
    """

    name: str
    topic: str
    plain: bool = True


@dataclass(frozen=True)
class StoredCalibration:
    """An accepted calibration: the camera, the frame its images were in, and the file's content.

    frame_id: None where the file does not say it. contradictions: how many calibrations in a row
    contradict it. edited: it is not what a node wrote; then the camera's sigma is unknown. mount:
    how the camera sits on the car, where that is known.
    """

    camera: NamedCamera
    frame_id: str | None
    content: Mapping[str, Any]
    contradictions: int = 0
    edited: bool = False
    mount: Mount | None = None

    @classmethod
    def of(cls, calibration: Calibration, whose: CameraIdentity, frame_id: str, publisher: str = ''
           ) -> StoredCalibration:
        """Make it of a calibration that was accepted just now; publisher: the images' node."""
        now = datetime.now(timezone.utc).isoformat(timespec='seconds')
        content = yaml.safe_load(calibration_yaml(calibration, whose.name, now))
        content['dashcalib'] |= {'topic': whose.topic, 'frame_id': frame_id,
                                 'publisher': publisher}
        content['dashcalib'][CHECKSUM] = _checksum(content)
        return cls(calibrated_camera(calibration, whose.name), frame_id, content,
                   mount=calibration.mount)

    @classmethod
    def read(cls, text: str, path: Path, whose: CameraIdentity) -> StoredCalibration:
        """Read a file's text; raises InputError unless it is of this node's camera.

        With the code E-KEPT-IMPLAUSIBLE for this camera's file with numbers that no lens has.
        """
        try:
            camera = parse_camera(text, path)
        except InputError as error:
            content = parse_yaml(text, str(path)) if error.code in NO_LENS else None
            if not isinstance(content, dict) or not isinstance(content.get('dashcalib'), dict):
                raise
            _check_owner(content, whose)
            raise InputError('E-KEPT-IMPLAUSIBLE', str(error)) from error
        if camera.verdict != 'accepted' or camera.sigma is None:
            raise InputError('E-KEPT-NOT-ACCEPTED',
                             'it is not an accepted calibration of this node; it is moved aside '
                             'when the node has one')
        content = parse_yaml(text, str(path))
        _check_owner(content, whose)
        if why := implausible(camera):
            raise InputError('E-KEPT-IMPLAUSIBLE', why)
        own = content['dashcalib']
        count, frame_id = own.get(COUNT, 0), own.get('frame_id')
        # an older file has neither
        older = own.get('topic') is None and CHECKSUM not in own
        edited = not older and own.get(CHECKSUM) != _checksum(content)
        return cls(camera, None if frame_id is None else str(frame_id), content,
                   count if type(count) is int and count > 0 else 0, edited,
                   None if edited else camera.mount)

    @property
    def days(self) -> float:
        """Return its age in days; 0 where the file does not say when it was made."""
        with suppress(KeyError, TypeError, ValueError):
            made = datetime.fromisoformat(str(self.content['dashcalib']['created']))
            return (datetime.now(timezone.utc) - made).total_seconds() / 86400
        return 0.0

    @property
    def text(self) -> str:
        """Return the file's text."""
        return yaml_text(self.content)

    def rectified(self, rectified: str) -> StoredCalibration:
        """Return it with the P of a setting, itself where the file has that already.

        P is not a measurement but the user's choice: the present one counts, not the file's.
        """
        p = ros_camera(self.camera.camera, rectified).p
        with suppress(KeyError, TypeError, ValueError):  # of another program's form
            if np.allclose(self.content['projection_matrix']['data'], p, rtol=1e-9, atol=0):
                return self
        return replace(self, content={**self.content, 'projection_matrix': matrix_block(3, 4, p)})

    def contradicted(self, times: int) -> StoredCalibration:
        """Return it with another number of contradictions in a row."""
        own = {**self.content['dashcalib'], COUNT: times}
        return replace(self, content={**self.content, 'dashcalib': own}, contradictions=times)


class Store:
    """One file of one node. If another program has written it, it is set aside, never overwritten.

    While a node has it, no other node reads or writes it: a file beside it is locked.
    """

    def __init__(self, path: Path, whose: CameraIdentity) -> None:
        """Raises OutputError where the path cannot be that of a file."""
        try:
            if not stat.S_ISREG(path.stat().st_mode):
                raise _not_written(path, 'it is a folder or a device, not a file')
        except FileNotFoundError:
            pass
        except (OSError, ValueError) as error:
            raise _not_written(path, error) from error
        self.path = path
        self._whose = whose
        self._lock: int | None = None
        # the text that this node last read or wrote: a different one is another program's
        self._text: str | None = None
        # the text of a calibration that was given up, but could not be moved aside
        self._given_up: str | None = None
        remove_leftovers(self.path.parent, (self.path.name,))

    def claim(self) -> bool:
        """Take the file unless another node has it; return whether this node has it."""
        if self._lock is not None:
            return True
        real = Path(os.path.realpath(self.path))
        with suppress(OSError):
            real.parent.mkdir(parents=True, exist_ok=True)
        # where nothing can be written, the file itself
        for path, flags in ((real.with_name(f'.{real.name}.lock'), os.O_CREAT), (real, 0)):
            try:
                lock = os.open(path, os.O_RDONLY | os.O_NONBLOCK | flags, 0o644)
            except OSError:
                continue
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                os.close(lock)
                if isinstance(error, BlockingIOError):
                    return False
                continue  # not every file system has locks
            self._lock = lock
            return True
        return True

    def close(self) -> None:
        """Leave the file to other nodes."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    @property
    def taken(self) -> str:
        """Return the line for the operator where another node has the file, else ''."""
        if self.claim():
            return ''
        return (f'another node uses {self.path}: this one neither publishes nor writes it; set '
                f'camera_name or camera_info_url so that each node has its own file')

    @property
    def given_up(self) -> str:
        """Return the line where the file still has a calibration that was given up, else ''."""
        if self._given_up is None or self._read() != self._given_up:
            return ''
        return (f'{self.path} was withdrawn, but could not be moved aside: remove it, or the next '
                f'start of the node publishes it again')

    def load(self) -> StoredCalibration | None:
        """Return the calibration, None if there is no file.

        Raises InputError when it is damaged, was given up, is another node's, another tool's (that
        has no sigma to compare with), or another camera's. One that no lens can have is set aside.
        """
        self._text = None
        if self.taken:
            raise InputError('E-KEPT-IN-USE', self.taken)
        try:
            if not (self.path.exists() or self.path.is_symlink()):
                return None
            text = read_text(self.path, YAML_BYTES)
            kept = StoredCalibration.read(text, self.path, self._whose)
        except InputError as error:
            text = (f'{self.path} is not used: {error}; {self._moved_aside()}'
                    if error.code == 'E-KEPT-IMPLAUSIBLE' else f'{self.path} is ignored: {error}')
            raise InputError(error.code, text) from error
        if self.given_up:
            raise InputError('E-KEPT-WITHDRAWN', self.given_up)
        self._text = text
        # its sigma may be what was edited
        return replace(kept, camera=replace(kept.camera, sigma=None)) if kept.edited else kept

    def save(self, kept: StoredCalibration) -> str:
        """Write it, completely or not at all; return a line about it. Raises OutputError."""
        if self.taken:
            raise OutputError('E-KEPT-IN-USE', self.taken)
        self._make_folder()
        moved = None if self._ours else set_aside(self.path)
        self._write(kept)
        self._given_up = None
        return f'saved to {self.path}' + (
            f'; what another program wrote there is now {moved}' if moved else '')

    def check_writable(self) -> None:
        """Try to write beside the file, before the drive and not after it. Raises OutputError."""
        self._make_folder()
        try:
            with prepared(self.path.parent, {self.path.name: b'yes\n'}):
                pass
        except OSError as error:
            raise _not_written(self.path, error) from error

    def _make_folder(self) -> None:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise _not_written(self.path, error) from error

    def update(self, kept: StoredCalibration) -> None:
        """Write it where the file is still what this node read or wrote. Raises OutputError."""
        if self._ours and self.claim():
            self._write(kept)

    def retire(self) -> str:
        """Set the file aside, so that it is not loaded again; return a line about it.

        That of another node stays. Raises OutputError when it could not be moved: this process
        does not load it again then, but the next start of the node does.
        """
        if self.taken:
            return self.taken
        try:
            moved = set_aside(self.path)
        except OutputError as error:
            self._given_up = self._read()
            raise OutputError(error.code, f'{error}; until then the next start of the node '
                                          f'publishes it again') from error
        self._text = self._given_up = None
        return f'{self.path} is now {moved}' if moved else 'there was no file'

    def _moved_aside(self) -> str:
        try:
            return f'it is now {set_aside(self.path)}'
        except OutputError as error:
            return str(error)

    @property
    def _ours(self) -> bool:
        return self._text is not None and self._read() == self._text

    def _write(self, kept: StoredCalibration) -> None:
        text = kept.text
        write_text(self.path, text)
        self._text = text

    def _read(self) -> str | None:
        try:
            return read_text(self.path, YAML_BYTES)
        except InputError:
            return None


def _not_written(path: Path, why: Exception | str) -> OutputError:
    reason = getattr(why, 'strerror', None) or str(why)
    return OutputError('E-KEPT-NOT-WRITABLE',
                       f'cannot write {path}: {reason}; set camera_info_url to a file in a folder '
                       f'that you may write to')


def _check_owner(content: Mapping[str, Any], whose: CameraIdentity) -> None:
    name, topic = content.get('camera_name'), content['dashcalib'].get('topic')
    if name != whose.name:
        raise InputError('E-KEPT-OF-OTHER-CAMERA',
                         f'it belongs to the camera {name}, and this one is {whose.name}; it is '
                         f'moved aside when this one is calibrated')
    if topic != whose.topic and not (topic is None and whose.plain):
        of = f'belongs to the images on {topic}' if topic else 'is older and names no topic'
        raise InputError('E-KEPT-OF-OTHER-TOPIC',
                         f'it {of}, and this node uses {whose.topic}; set camera_name so that '
                         f'each camera has its own file')


def implausible(kept: NamedCamera) -> str:
    """Return why no lens, or no solution, has such numbers; '' where one may."""
    camera, sigma = kept.camera, kept.sigma or {}
    width, height = camera.image_size
    if not FOCAL[0] <= camera.fx / width <= FOCAL[1]:
        return f'fx is {camera.fx:g} px in a picture {width} px wide'
    if not ASPECT[0] <= camera.fy / camera.fx <= ASPECT[1]:
        return f'fy is {camera.fy:g} px, and fx is {camera.fx:g} px'
    if not (abs(camera.cx / width - 0.5) <= 0.5 + BESIDE
            and abs(camera.cy / height - 0.5) <= 0.5 + BESIDE):
        return f'the principal point ({camera.cx:g}, {camera.cy:g}) is far from the picture'
    if not _real(camera):
        return 'no lens has its distortion'
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


def _checksum(content: Mapping[str, Any]) -> str:
    """Return that of what is published and of where it is from: of all but P and the count."""
    own = {key: value for key, value in content['dashcalib'].items()
           if key not in (CHECKSUM, COUNT)}
    sealed = {key: value for key, value in content.items() if key != 'projection_matrix'}
    try:
        text = json.dumps({**sealed, 'dashcalib': own}, sort_keys=True, default=str)
    except TypeError:  # keys that are not text: no node writes these
        return ''
    return hashlib.sha256(text.encode()).hexdigest()


def camera_info_path(url: str, camera_name: str) -> Path:
    """Return the file of a URL or path; empty: camera_info_manager's own place.

    ${ROS_HOME} is $ROS_HOME, or ~/.ros; ${NAME} the camera's name; ~ the home folder. Raises
    InputError for other schemes and variables, for a package that is not installed, and for the
    home folder of an unknown user.
    """
    values = {'NAME': camera_name, 'ROS_HOME': os.environ.get('ROS_HOME') or '~/.ros'}
    try:
        text = re.sub(r'\$\{(.*?)\}', lambda found: values[found[1]], url or DEFAULT)
    except KeyError as error:
        raise InputError('E-URL-VARIABLE-UNKNOWN',
                         f'camera_info_url {url}: there is no ${{{error.args[0]}}}; use '
                         f'${{ROS_HOME}} and ${{NAME}} only') from error
    scheme, separator, path = text.rpartition('://')
    if scheme.lower() == 'package':
        return _in_package(text)
    if (scheme.lower() not in ('', 'file') or path.endswith('/') or not path
            or (separator and not path.startswith(('/', '~')))):
        raise InputError('E-URL-INVALID',
                         f'camera_info_url {url} does not name a local file; use {KNOWN}')
    try:
        return Path(path).expanduser()
    except RuntimeError as error:  # the user, or the own home folder, is unknown
        raise InputError('E-HOME-UNKNOWN', f'there is no home folder for {path}; set '
                                           f'camera_info_url to a path without ~') from error


def _in_package(url: str) -> Path:
    from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
    parts = urlsplit(url)
    rest = parts.path.strip('/')
    if not parts.netloc or not rest:
        raise InputError('E-URL-INVALID',
                         f'camera_info_url {url} does not name a file in a package; use {KNOWN}')
    try:
        share = get_package_share_directory(parts.netloc)
    except (PackageNotFoundError, ValueError, OSError) as error:
        raise InputError('E-ROS-PACKAGE-MISSING',
                         f'camera_info_url {url}: there is no package {parts.netloc}; source its '
                         f'workspace, or use file://') from error
    return Path(share, rest)
