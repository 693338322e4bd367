# SPDX-License-Identifier: Apache-2.0
"""Images in: bags, videos and folders as iterables of Frame.

Nothing here imports OpenCV or rosbags before a drive is opened: `--help` stays quick.
"""
from dashcalib_ros.input.source import Frame, FrameSource

__all__ = ['Frame', 'FrameSource']
