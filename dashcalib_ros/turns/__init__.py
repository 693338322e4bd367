"""Epipole distances -> turns: streaming median, peaks, prominence; the bank of the best."""
from dashcalib_ros.turns.detector import TurnDetector
from dashcalib_ros.turns.turn import Turn

__all__ = ['Turn', 'TurnDetector']
