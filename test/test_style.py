# SPDX-License-Identifier: Apache-2.0
"""The linters are part of the tests: what they find fails here too."""
import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parent.parent
LICENCE = 'SPDX-License-Identifier: Apache-2.0'
# each has other types of arrays, and what one takes another may not: newest of Python 3.11, 3.12
CHECKED_WITH = ('2.4', '2.5')
# the source distribution has no benchmarks
MYPY = ['mypy'] if (ROOT / 'benchmark').is_dir() else ['mypy', 'dashcalib_ros']


def test_every_source_file_names_its_licence():
    sources = [ROOT / 'setup.py', *(
        path for folder in ('dashcalib_ros', 'test', 'testing', 'benchmark', 'docs', 'examples',
                            'launch', 'scripts', 'config')
        for path in (ROOT / folder).rglob('*')
        if path.suffix in ('.py', '.sh', '.xml', '.rviz') or path.parent == ROOT / 'scripts')]
    assert len(sources) > 100
    lacking = [str(path.relative_to(ROOT)) for path in sources if path.is_file()
               and LICENCE not in '\n'.join(path.read_text().splitlines()[:2])]
    assert lacking == [], f'begin with: # {LICENCE}'


@pytest.mark.parametrize('command', [['ruff', 'check', '.'], MYPY])
def test_the_code_is_clean(command):
    if importlib.util.find_spec(command[0]) is None:
        # rosdep has no key for ruff: colcon test does without
        pytest.skip(f'{command[0]} is not installed: pip install the test extra')
    if command[0] == 'mypy' and '.'.join(np.__version__.split('.')[:2]) not in CHECKED_WITH:
        pytest.skip(f'types are checked with numpy {" and ".join(CHECKED_WITH)}, '
                    f'this is {np.__version__}')
    done = subprocess.run([sys.executable, '-m', *command], cwd=ROOT, capture_output=True,
                          text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
