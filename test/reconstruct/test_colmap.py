# SPDX-License-Identifier: Apache-2.0
"""What COLMAP logs goes to stderr only."""
from __future__ import annotations

import os
import subprocess
import sys

import pytest

pytest.importorskip('pycolmap')
PROGRAM = """
from dashcalib_ros.reconstruct.colmap import pycolmap
pycolmap.logging.warning('said by COLMAP')
"""


def test_no_log_is_left_in_the_scratch_folder(tmp_path):
    done = subprocess.run([sys.executable, '-c', PROGRAM], capture_output=True, text=True,
                          timeout=60, env={**os.environ, 'TMPDIR': str(tmp_path)}, check=True)
    assert 'said by COLMAP' in done.stderr
    assert list(tmp_path.iterdir()) == []
