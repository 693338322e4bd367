# SPDX-License-Identifier: Apache-2.0
"""Rendered drives with exact truth: the embedded default input, and the tests' fixture."""
from dashcalib_ros.demo.demos import DEMOS, demo_drive
from dashcalib_ros.demo.drive import Drive, render, render_to_bag
from dashcalib_ros.demo.fisheye import FisheyeLens
from dashcalib_ros.demo.glass import Glass
from dashcalib_ros.demo.lens import Lens
from dashcalib_ros.demo.rig import RIGS, rig_drives, true_places
from dashcalib_ros.demo.spec import DriveSpec, Mounting, Stop, Turn

__all__ = ['DEMOS', 'RIGS', 'Drive', 'DriveSpec', 'FisheyeLens', 'Glass', 'Lens', 'Mounting',
           'Stop', 'Turn',
           'demo_drive', 'render', 'render_to_bag', 'rig_drives', 'true_places']
