"""Scenes -> Intrinsics, sigma, Verdict."""
from dashcalib_ros.intrinsics.calibration import Calibration, Intrinsics, TurnSummary, Verdict

__all__ = ['Calibration', 'Intrinsics', 'TurnSummary', 'Verdict']
