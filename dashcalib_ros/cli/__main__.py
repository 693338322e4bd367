"""python -m dashcalib_ros.cli: the same as the installed command."""
import sys

from dashcalib_ros.cli import main

sys.exit(main())
