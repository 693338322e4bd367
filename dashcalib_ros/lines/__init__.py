"""Upright lines of the world, found over the drive, and how a camera bends them.

A witness that knows nothing of motion: poles and the edges of houses are straight.
"""
from dashcalib_ros.lines.bend import Bend, bend
from dashcalib_ros.lines.collector import LineCollector
from dashcalib_ros.lines.edges import Lines

__all__ = ['Bend', 'LineCollector', 'Lines', 'bend']
