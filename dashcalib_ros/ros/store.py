"""The last accepted calibration on disk, where camera_info_manager looks for it too."""
from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

import yaml

from dashcalib_ros.errors import InputError, OutputError
from dashcalib_ros.intrinsics import Calibration
from dashcalib_ros.report import Camera, calibration_yaml, camera_of, write_text
from dashcalib_ros.report.camera_yaml import parse_calibration_yaml


@dataclass(frozen=True)
class Kept:
    """An accepted calibration: the camera, the frame its images were in, and the file's text."""

    camera: Camera
    frame_id: str
    text: str

    @classmethod
    def of(cls, calibration: Calibration, name: str, frame_id: str) -> Kept:
        """Make it of a calibration that was accepted just now."""
        now = datetime.now(timezone.utc).isoformat(timespec='seconds')
        document = yaml.safe_load(calibration_yaml(calibration, name, now))
        document['dashcalib']['frame_id'] = frame_id
        text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=2**20,
                              allow_unicode=True)
        return cls(camera_of(calibration, name), frame_id, text)


class Store:
    """One file. A calibration that another tool left there is set aside, never overwritten."""

    def __init__(self, path: str, camera_name: str) -> None:
        """path: empty for camera_info_manager's place and name; ~ is expanded.

        Raises InputError for the home of a user that there is not.
        """
        place = Path(path) if path else (
            Path(os.environ.get('ROS_HOME') or '~/.ros', 'camera_info', f'{camera_name}.yaml'))
        try:
            self.path = place.expanduser()
        except RuntimeError as error:  # there is no such user, or nobody knows the own home
            raise InputError(f'there is no home folder for {place}; set camera_info_file to a '
                             f'path without ~') from error
        self.previous = self.path.with_suffix('.previous.yaml')
        self._foreign = False

    def load(self) -> Kept | None:
        """Return the calibration, None if there is no file.

        Raises InputError when it is damaged or none of ours: another tool's has no sigma to
        compare with.
        """
        self._foreign = False
        if not self.path.exists():
            return None
        try:
            text = self.path.read_text('utf-8')
            camera = parse_calibration_yaml(text, self.path)
        except (OSError, UnicodeDecodeError, InputError) as error:
            self._foreign = True
            raise InputError(f'{self.path} is ignored: {_plain(error)}') from error
        if camera.verdict != 'accepted' or camera.sigma is None:
            self._foreign = True
            raise InputError(f'{self.path} is ignored: it is no accepted calibration of this '
                             f'node; it is moved to {self.previous.name} when there is one')
        own = yaml.safe_load(text)['dashcalib']
        return Kept(camera, str(own.get('frame_id', '')), text)

    def save(self, kept: Kept) -> None:
        """Write it, whole or not at all. Raises OutputError."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f'cannot make {self.path.parent}: {error.strerror}; set '
                              f'camera_info_file to a place you may write to') from error
        if self._foreign:
            self.retire()
        write_text(self.path, kept.text)
        self._foreign = False

    def retire(self) -> None:
        """Move the file out of the way, so that it is not loaded again."""
        with suppress(OSError):
            self.path.replace(self.previous)


def _plain(error: Exception) -> str:
    return (error.strerror or str(error)) if isinstance(error, OSError) else str(error)
