"""Rendered drives with exact truth: the embedded default input, and the tests' fixture."""
from dashcalib_ros.demo.bag import render_to_bag
from dashcalib_ros.demo.drive import Drive, demo_drive, render
from dashcalib_ros.demo.glass import Glass
from dashcalib_ros.demo.lens import Lens
from dashcalib_ros.demo.spec import DriveSpec, Stop, Turn

__all__ = ['Drive', 'DriveSpec', 'Glass', 'Lens', 'Stop', 'Turn', 'demo_drive',
           'render', 'render_to_bag']
