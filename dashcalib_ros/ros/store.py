"""The last accepted calibration on disk, by default where camera_info_manager finds it."""
from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from dashcalib_ros.camera import ros_camera
from dashcalib_ros.errors import InputError, OutputError
from dashcalib_ros.judgement import Calibration
from dashcalib_ros.limits import YAML_BYTES, parse_yaml, read_text
from dashcalib_ros.report import (
    NamedCamera,
    calibrated_camera,
    calibration_yaml,
    remove_leftovers,
    set_aside,
    write_text,
)
from dashcalib_ros.report.camera_yaml import parse_calibration_yaml


@dataclass(frozen=True)
class Kept:
    """An accepted calibration: the camera, the frame its images were in, and the file's text."""

    camera: NamedCamera
    frame_id: str
    text: str

    @classmethod
    def of(cls, calibration: Calibration, name: str, frame_id: str) -> Kept:
        """Make it of a calibration that was accepted just now."""
        now = datetime.now(timezone.utc).isoformat(timespec='seconds')
        document = yaml.safe_load(calibration_yaml(calibration, name, now))
        document['dashcalib']['frame_id'] = frame_id
        return cls(calibrated_camera(calibration, name), frame_id, _dumped(document))

    def rectified(self, rectified: str) -> Kept:
        """Return it with the P of a setting, itself where the file has that already.

        P is no measurement but the user's choice: the present one counts, not the file's.
        """
        document = parse_yaml(self.text, self.camera.name)
        p = ros_camera(self.camera.camera, rectified).p
        before = document.get('projection_matrix')
        if isinstance(before, dict) and _equal(before.get('data'), p):
            return self
        document['projection_matrix'] = {'rows': 3, 'cols': 4, 'data': p}
        return replace(self, text=_dumped(document))


def _dumped(document: dict[str, Any]) -> str:
    text: str = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=2**20,
                               allow_unicode=True)
    return text


def _equal(data: Any, p: list[float]) -> bool:
    try:
        return bool(np.allclose(np.asarray(data, np.float64), p, rtol=1e-9, atol=0))
    except (TypeError, ValueError):
        return False


class Store:
    """One file. If another program has written it, it is set aside, never overwritten."""

    def __init__(self, path: Path) -> None:
        self.path = path
        # the text that this node last read or wrote: a different one is another program's
        self._text: str | None = None
        # the text of a calibration that was given up, but could not be moved aside
        self._given_up: str | None = None
        remove_leftovers(self.path.parent, (self.path.name,))

    @property
    def given_up(self) -> bool:
        """Return whether the file still has a calibration that was given up."""
        return self._given_up is not None and self._read() == self._given_up

    def load(self) -> Kept | None:
        """Return the calibration, None if there is no file.

        Raises InputError when it is damaged, was given up, or is another tool's: that has no sigma
        to compare with.
        """
        self._text = None
        with suppress(OSError):  # reading fails, too, and raises InputError below
            if not self._exists():
                return None
        try:
            text = read_text(self.path, YAML_BYTES)
            camera = parse_calibration_yaml(text, self.path)
        except (InputError, ValueError, OverflowError) as error:
            raise InputError(f'{self.path} is ignored: {error}') from error
        if text == self._given_up:
            raise InputError(f'{self.path} is ignored: it was given up, but could not be moved '
                             f'aside; remove it')
        if camera.verdict != 'accepted' or camera.sigma is None:
            raise InputError(f'{self.path} is ignored: it is no accepted calibration of this '
                             f'node; it is moved aside when there is one')
        self._text = text
        own = parse_yaml(text, str(self.path))['dashcalib']
        return Kept(camera, str(own.get('frame_id', '')), text)

    def save(self, kept: Kept) -> Path | None:
        """Write it, completely or not at all. Raises OutputError.

        Returns the new path of another program's file, None if there was none.
        """
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f'cannot make {self.path.parent}: {error.strerror}; set '
                              f'camera_info_url to a place you may write to') from error
        ours = self._text is not None and self._read() == self._text
        moved = None if ours else set_aside(self.path)
        write_text(self.path, kept.text)
        self._text, self._given_up = kept.text, None
        return moved

    def retire(self) -> Path | None:
        """Set the file aside, so that it is not loaded again; return its new path.

        None if there was no file. Raises OutputError when it could not be moved: this process
        does not load it again then, but the next start of the node does.
        """
        try:
            moved = set_aside(self.path)
        except OutputError:
            self._given_up = self._read()
            raise
        self._text = self._given_up = None
        return moved

    def _exists(self) -> bool:
        try:
            self.path.lstat()
        except (FileNotFoundError, NotADirectoryError):
            return False
        return True

    def _read(self) -> str | None:
        try:
            return read_text(self.path, YAML_BYTES)
        except InputError:
            return None
