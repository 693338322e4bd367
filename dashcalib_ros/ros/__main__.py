# SPDX-License-Identifier: Apache-2.0
"""python -m dashcalib_ros.ros [calibrator | checker | rig] ...: without the installed commands."""
import sys

from dashcalib_ros.ros import main
from dashcalib_ros.ros.interface import CALIBRATOR, PROGRAMS

arguments = sys.argv[1:]
named = arguments[0] if arguments[:1] and arguments[0] in PROGRAMS else ''
sys.exit(main(named or CALIBRATOR, arguments[bool(named):]))
