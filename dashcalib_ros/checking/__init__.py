"""Does a given calibration explain a drive? Solution and camera -> Check; with poses, Odometry.

And turn by turn: scene and camera -> Reading; readings -> Monitor, which names changes.
"""
from dashcalib_ros.checking.check import Check, check, with_faults
from dashcalib_ros.checking.monitor import Change, Monitor, watch
from dashcalib_ros.checking.odometry import Odometry, odometry, trivial_guess
from dashcalib_ros.checking.paths import path_files
from dashcalib_ros.checking.poses import Poses, read_poses
from dashcalib_ros.checking.reading import Reading
from dashcalib_ros.checking.witness import with_lines

__all__ = ['Change', 'Check', 'Monitor', 'Odometry', 'Poses', 'Reading', 'check', 'odometry',
           'path_files', 'read_poses', 'trivial_guess', 'watch', 'with_faults', 'with_lines']
