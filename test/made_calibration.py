# SPDX-License-Identifier: Apache-2.0
"""A small but complete calibration, made by hand."""
from __future__ import annotations

import dataclasses

import numpy as np

from dashcalib_ros.camera import Brown, Fisheye, Radial, Rational
from dashcalib_ros.config import Config
from dashcalib_ros.errors import Notice
from dashcalib_ros.judge import TurnSummary, Verdict
from dashcalib_ros.judge.calibration import Mount
from dashcalib_ros.report import Calibration

SIZE = (1242, 375)
TRUTH = Radial(SIZE, 721.5377, 724.25, 609.5593, 172.854, -0.363, 0.151)
SIGMA = dict(zip(TRUTH.names(), (3.5, 3.75, 2.0, 2.25, 0.004, 0.003), strict=True))
# one camera of each model
EACH_MODEL = {
    'radial': TRUTH,
    'brown': Brown.of(SIZE, [*TRUTH.params, 0.00034, -0.0012, -0.004]),
    'rational_polynomial': Rational.of(
        SIZE, [*TRUTH.params, 0.00034, -0.0012, -0.004, 0.02, -0.003, 0.0011]),
    'fisheye': Fisheye(SIZE, 420.0, 421.5, 615.0, 180.0, -0.021, 0.0043, -0.0021, 0.00034)}


MOUNT = Mount('accepted', (), 2.0, -1.0, None, 1.4, {
    'yaw_left_deg': 0.1, 'pitch_up_deg': 0.1, 'roll_right_deg': None, 'height_m': 0.03},
    (600.0, 170.0), 0.5, 300.0)


def calibration_of(camera, level='accepted', **changes):
    """Make a calibration of any camera, with sigmas for all its parameters."""
    sigma = dict(zip(camera.names(), (3.5, 3.75, 2.0, 2.25, 0.004, 0.003, 0.0002, 0.00005, 0.001,
                                      0.002, 0.003, 0.004),
                     strict=False))
    return make_calibration(level, camera=camera, sigma=sigma, **changes)


def make_calibration(level='accepted', **changes):
    """Make a small but complete calibration by hand; refused ones have no intrinsics."""
    turn = TurnSummary(88, 58, 118, 8.8, 0.061, 31, 30, True, 91.5, 0.46, 1.1)
    unused = TurnSummary(275, 245, 305, 27.5, 0.012, 31, 4, False)
    stamps = np.arange(300) * 0.1
    magnitude = 0.01 + 0.06 * np.exp(-((stamps - 8.8) / 1.5) ** 2)
    mask = np.ones((375, 1242), bool)
    mask[300:] = False
    calibration = Calibration(
        verdict=Verdict(level, () if level == 'accepted' else (Notice('', 'only 1 of 5 turns'),)),
        image_size=SIZE,
        camera=None if level == 'refused' else TRUTH,
        sigma=None if level == 'refused' else SIGMA,
        turns=(turn, unused), frames=300, reprojection_error_px=0.46,
        timing={'detect': 3.0, 'calibrate': 20.0, 'total': 23.0},
        versions={'pycolmap': '4.2.1'}, config=Config(seed=7), input_name='drive.mcap',
        magnitudes=np.column_stack([stamps, magnitude]), mask=mask)
    return dataclasses.replace(calibration, **changes)
