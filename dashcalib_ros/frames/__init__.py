"""Images in: bags, videos and folders as iterables of Frame.

Nothing here imports OpenCV or rosbags before a drive is opened: `--help` stays quick.
"""
from dashcalib_ros.frames.frame import Frame
from dashcalib_ros.frames.source import FrameSource, open_frames

__all__ = ['Frame', 'FrameSource', 'open_frames']
