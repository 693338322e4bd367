"""Turning magnitudes -> turns: streaming median, peaks, prominence; the bank of the best turns."""
from dashcalib_ros.turns.detector import TurnDetector
from dashcalib_ros.turns.turn import Turn, TurnId

__all__ = ['Turn', 'TurnDetector', 'TurnId']
