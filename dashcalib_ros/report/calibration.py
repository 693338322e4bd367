# SPDX-License-Identifier: Apache-2.0
"""Calibration, as users have it: the result with its files."""
from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dashcalib_ros.camera import Camera
from dashcalib_ros.errors import NotAcceptedError
from dashcalib_ros.formats import load_calibration, result_dict
from dashcalib_ros.judge import CalibrationData
from dashcalib_ros.limits import path_of
from dashcalib_ros.report.files import write_results
from dashcalib_ros.report.page import notebook_html
from dashcalib_ros.report.wording import PARAMETERS, parameter_rows


@dataclass(frozen=True, repr=False)
class Calibration(CalibrationData):  # noqa: D101, it is the base's, which has the attributes
    __doc__ = CalibrationData.__doc__

    @staticmethod
    def of(data: CalibrationData) -> Calibration:
        """Return the same result with its files."""
        return Calibration(**vars(data))

    @staticmethod
    def load(path: str | os.PathLike[str]) -> Calibration:
        """Read what save() and `dashcalib run` write: result.json, its folder, calibration.yaml.

        A result.json has everything but the mask, the turning magnitudes and what the report
        draws; a calibration.yaml has camera, sigma, verdict and versions. Raises InputError;
        load_camera() reads other files.
        """
        return Calibration.of(load_calibration(path))

    def save(self, folder: str | os.PathLike[str] = 'calibration') -> tuple[Path, ...]:
        """Write what `dashcalib run` writes into a folder, and return the files' paths.

        These are result.json, calibration.yaml (calibration.weak.yaml where it is weak, none where
        it is refused), and report.html, unless there is no room for it. Raises OutputError, which
        names the remedy.
        """
        return write_results(self, path_of(folder)).files

    def to_dict(self) -> dict[str, Any]:
        """Return the content of result.json: dicts, lists, text, finite numbers and None."""
        return result_dict(self)

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the verdict with its reasons, and the parameters."""
        return notebook_html(self.verdict.level, [
            *map(str, self.verdict.main_reasons), self.caveat], PARAMETERS, parameter_rows(self))

    def accepted(self) -> AcceptedCalibration:
        """Return the same calibration, whose camera and sigma are known not to be None.

        Raises NotAcceptedError with the reasons if it is weak or refused.
        """
        if self.verdict.level != 'accepted':
            raise NotAcceptedError('E-NOT-ACCEPTED', f'the calibration is {self.verdict.level}: '
                                                     f'{self.verdict.main_text}')
        return AcceptedCalibration(**vars(self))


@dataclass(frozen=True, repr=False)
class AcceptedCalibration(Calibration):
    """An accepted calibration, from Calibration.accepted(): camera and sigma are there."""

    camera: Camera
    sigma: Mapping[str, float] = field(hash=False)

    @property
    def intrinsics(self) -> dict[str, float]:
        """Return the camera's parameters by name."""
        return self.camera.named
