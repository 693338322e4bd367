"""Solution -> verdict with reasons -> Calibration.

Does a given calibration explain a drive? Solution and camera -> Check; with poses, Odometry. And
turn by turn: scene and camera -> Reading; readings -> Monitor, which names changes.
"""
from dashcalib_ros.judge.calibration import Calibration, TurnSummary, Verdict
from dashcalib_ros.judge.check import Check, check, with_faults
from dashcalib_ros.judge.monitor import Change, Monitor, watch
from dashcalib_ros.judge.odometry import Odometry, odometry, trivial_guess
from dashcalib_ros.judge.paths import path_files
from dashcalib_ros.judge.poses import Poses, read_poses, track_poses
from dashcalib_ros.judge.reading import Reading
from dashcalib_ros.judge.witness import with_lines

__all__ = ['Calibration', 'Change', 'Check', 'Monitor', 'Odometry', 'Poses', 'Reading',
           'TurnSummary', 'Verdict', 'check', 'odometry', 'path_files', 'read_poses',
           'track_poses', 'trivial_guess', 'watch', 'with_faults', 'with_lines']
