"""python -m dashcalib_ros.ros: the node, without the installed command."""
import sys

from dashcalib_ros.ros import main

sys.exit(main())
