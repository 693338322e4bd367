"""The linters are part of the tests: what they find fails here too."""
import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.mark.parametrize('command', [['ruff', 'check', '.'], ['mypy', 'dashcalib_ros']])
def test_the_code_is_clean(command):
    if importlib.util.find_spec(command[0]) is None:
        # rosdep has no key for ruff: colcon test does without
        pytest.skip(f'{command[0]} is not installed: pip install the test extra')
    done = subprocess.run([sys.executable, '-m', *command], cwd=ROOT, capture_output=True,
                          text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
