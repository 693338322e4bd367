"""Recorded drives in one call: files in, a Calibration or an answer out."""
from __future__ import annotations

from dataclasses import replace

from dashcalib_ros.calibrator import Calibrator
from dashcalib_ros.camera import Camera
from dashcalib_ros.checking import Check
from dashcalib_ros.config import Config
from dashcalib_ros.frames import FrameSource
from dashcalib_ros.inputs import Paths, open_frames
from dashcalib_ros.judgement import Calibration


def calibrate(path: Paths, fps: float | None = None,
              config: Config | None = None, topic: str | None = None, start_s: float = 0.0,
              duration_s: float | None = None) -> Calibration:
    """Calibrate a recorded drive.

    path, topic, fps, start_s, duration_s: as for open_frames(). Raises InputError for what cannot
    be read; a drive that teaches too little gives a calibration that is weak or refused.
    """
    source = open_frames(path, topic, fps, start_s, duration_s)
    with Calibrator(config) as calibrator:
        for frame in source:
            calibrator.push(frame)
        return with_source(calibrator.calibrate(), source)


def check(given: Camera, path: Paths, fps: float | None = None,
          config: Config | None = None, topic: str | None = None, start_s: float = 0.0,
          duration_s: float | None = None) -> Check:
    """Say whether a camera explains a recorded drive.

    given: of the drive's pictures. All others are those of open_frames(). Raises InputError for
    what cannot be read.
    """
    with Calibrator(config) as calibrator:
        for frame in open_frames(path, topic, fps, start_s, duration_s):
            calibrator.push(frame)
        return calibrator.check(given, calibrator.calibrate())


def with_source(calibration: Calibration, source: FrameSource) -> Calibration:
    """Return the calibration with its input's name and warnings."""
    new = tuple(line for line in source.warnings if line not in calibration.warnings)
    return replace(calibration, input_name=calibration.input_name or source.name,
                   warnings=(*new, *calibration.warnings))
