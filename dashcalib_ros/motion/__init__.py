"""Frames -> tracked points -> epipoles: how much the car turns; the ego-vehicle mask."""
from dashcalib_ros.motion.estimator import MotionEstimator
from dashcalib_ros.motion.motion import Motion

__all__ = ['Motion', 'MotionEstimator']
