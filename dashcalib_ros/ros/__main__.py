"""python -m dashcalib_ros.ros: the node, also where nothing is installed."""
import sys

from dashcalib_ros.ros import main

sys.exit(main())
