"""Importing this module silences OpenCV and FFmpeg, which report every defect of a file on stderr.

What a user must know comes as our own errors and warnings. Set OPENCV_LOG_LEVEL or
OPENCV_FFMPEG_LOGLEVEL to see the rest.
"""
import os

import cv2

os.environ.setdefault('OPENCV_FFMPEG_LOGLEVEL', '-8')  # read when the first video is opened
if 'OPENCV_LOG_LEVEL' not in os.environ:
    # OpenCV 4 has it elsewhere
    set_log_level = getattr(cv2, 'setLogLevel', None) or cv2.utils.logging.setLogLevel
    set_log_level(0)  # LOG_LEVEL_SILENT
