"""Images in: bags, videos and folders as iterables of Frame."""
from dashcalib_ros.frames.frame import Frame

__all__ = ['Frame']
