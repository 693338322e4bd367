# SPDX-License-Identifier: Apache-2.0
"""Solution -> verdict with reasons -> CalibrationData.

Does a given calibration explain a drive? Solution and camera -> Check; with poses, Odometry. And
turn by turn: scene and camera -> Reading; readings -> Monitor, which names changes.
"""
from dashcalib_ros.judge.calibration import CalibrationData, TurnSummary, Verdict
from dashcalib_ros.judge.check import Check, check, with_faults
from dashcalib_ros.judge.monitor import Change, Monitor, Reading, moved_text, readings_of, watch
from dashcalib_ros.judge.mount import moved
from dashcalib_ros.judge.odometry import (
    Odometry,
    beside_poses,
    odometry,
    path_files,
    trivial_guess,
)

__all__ = ['CalibrationData', 'Change', 'Check', 'Monitor', 'Odometry', 'Reading', 'TurnSummary',
           'Verdict', 'beside_poses', 'check', 'moved', 'moved_text', 'odometry', 'path_files',
           'readings_of', 'trivial_guess', 'watch', 'with_faults']
