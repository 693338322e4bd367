# SPDX-License-Identifier: Apache-2.0
"""Frames -> tracks -> epipoles -> turning magnitudes -> peaks -> the bank of the best turns.

Also the ego-vehicle mask, and upright lines of the world, which are a witness of the lens.
"""
from dashcalib_ros.detect.bend import Bend, bend
from dashcalib_ros.detect.detector import TurnDetector
from dashcalib_ros.detect.edges import LineCollector, Lines
from dashcalib_ros.detect.estimator import Motion, MotionEstimator
from dashcalib_ros.detect.turn import Turn, TurnId

__all__ = ['Bend', 'LineCollector', 'Lines', 'Motion', 'MotionEstimator', 'Turn', 'TurnDetector',
           'TurnId', 'bend']
