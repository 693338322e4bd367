"""Solution -> verdict with reasons -> Calibration."""
from dashcalib_ros.judgement.calibration import Calibration, TurnSummary, Verdict

__all__ = ['Calibration', 'TurnSummary', 'Verdict']
