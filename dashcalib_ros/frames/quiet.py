"""Importing this keeps OpenCV and FFmpeg from reporting every oddity of a broken file on stderr.

All that matters comes as our own errors and warnings. Who wants to see the rest sets
OPENCV_LOG_LEVEL or OPENCV_FFMPEG_LOGLEVEL.
"""
import os

import cv2

os.environ.setdefault('OPENCV_FFMPEG_LOGLEVEL', '-8')  # read when the first video is opened
if 'OPENCV_LOG_LEVEL' not in os.environ:
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
