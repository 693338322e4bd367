# SPDX-License-Identifier: Apache-2.0
"""Importing this makes the helpers of the tests (ros_bench, fleet_made and others) importable."""
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / 'test'), str(ROOT)]
# two modules of tests are used, too: their damaged files, their made pairs of images
sys.path += [str(ROOT / 'test' / room) for room in ('judge', 'store')]
