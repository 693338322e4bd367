# SPDX-License-Identifier: Apache-2.0
"""python -m dashcalib_ros: the same as the installed command."""
from dashcalib_ros.cli import command

command()
