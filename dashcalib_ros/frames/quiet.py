"""Importing this module silences OpenCV and FFmpeg, which report every defect of a file on stderr.

What a user must know comes as our own errors and warnings. Set OPENCV_LOG_LEVEL or
OPENCV_FFMPEG_LOGLEVEL to see the rest.
"""
import os

import cv2

os.environ.setdefault('OPENCV_FFMPEG_LOGLEVEL', '-8')  # read when the first video is opened
if 'OPENCV_LOG_LEVEL' not in os.environ:
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
