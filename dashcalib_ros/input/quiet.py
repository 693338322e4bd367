"""Importing this module silences OpenCV, which reports every defect of a file on stderr.

What a user must know comes as our own errors and warnings. Set OPENCV_LOG_LEVEL to see the rest.
"""
import os

import cv2

if 'OPENCV_LOG_LEVEL' not in os.environ:
    # OpenCV 4 has it elsewhere
    set_log_level = getattr(cv2, 'setLogLevel', None) or cv2.utils.logging.setLogLevel
    set_log_level(0)  # LOG_LEVEL_SILENT
