# SPDX-License-Identifier: Apache-2.0
# PYTHON_ARGCOMPLETE_OK
"""The command dashcalib: argument parsing, terminal output, exit codes.

Only what --help needs is imported here; each command imports its own in its function.
"""
from dashcalib_ros.cli.program import command, main

__all__ = ['command', 'main']
