# SPDX-License-Identifier: Apache-2.0
"""Files that describe a camera, ours and other programs': a module for each, and their table."""
from dashcalib_ros.formats.export import export
from dashcalib_ros.formats.load import Given, given_camera, load_camera
from dashcalib_ros.formats.ours import (
    calibrated_camera,
    calibration_yaml,
    load_calibration,
    result_dict,
    result_json,
)

__all__ = ['Given', 'calibrated_camera', 'calibration_yaml', 'export', 'given_camera',
           'load_calibration', 'load_camera', 'result_dict', 'result_json']
