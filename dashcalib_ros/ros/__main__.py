"""python -m dashcalib_ros.ros [checker] ...: a node, without the installed commands."""
import sys

from dashcalib_ros.ros import main
from dashcalib_ros.ros.interface import CALIBRATOR, CHECKER

arguments = sys.argv[1:]
checks = arguments[:1] == [CHECKER]
sys.exit(main(CHECKER if checks else CALIBRATOR, arguments[checks:]))
