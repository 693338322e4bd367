"""The command as a user meets it, in its own process: help, usage, missing input, compare."""
from __future__ import annotations

import dataclasses
import json
import os
import re
import subprocess
import sys

import pytest
from test_report_result import TRUTH, make_calibration

from dashcalib_ros.report import write_results

HEAVY = ('numpy', 'cv2', 'scipy', 'yaml', 'rich', 'matplotlib', 'pycolmap', 'rosbags', 'rclpy')


def dashcalib(*args, env=None):
    return subprocess.run([sys.executable, '-m', 'dashcalib_ros.cli', *map(str, args)],
                          capture_output=True, text=True, env=env, timeout=120)


def assert_one_line_error(done, code=2):
    assert done.returncode == code, done.stderr
    assert done.stderr.startswith('dashcalib: error: '), done.stderr
    assert done.stderr.count('\n') == 1, done.stderr
    assert done.stdout == ''


@pytest.fixture
def results(tmp_path):
    """Make a folder with an accepted result and a truth."""
    write_results(make_calibration(), tmp_path / 'a')
    (tmp_path / 'truth.json').write_text(json.dumps(
        {**dataclasses.asdict(TRUTH), 'fx': TRUTH.fx - 7, 'width': 1242, 'height': 375}))
    return tmp_path


@pytest.mark.parametrize('command', [[], ['run'], ['turns'], ['demo'], ['compare']])
def test_help_names_the_exit_codes(command):
    done = dashcalib(*command, '--help')
    assert (done.returncode, done.stderr) == (0, '')
    assert done.stdout.startswith('usage: dashcalib')
    assert '3 weak or refused' in ' '.join(done.stdout.split())


def test_help_imports_nothing_heavy():
    code = ('import sys; from dashcalib_ros.cli import main; before = main(["run", "--help"]); '
            f'print(before, [name for name in {HEAVY} if name in sys.modules])')
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == '0 []', done.stdout + done.stderr


def test_version():
    done = dashcalib('--version')
    assert done.returncode == 0 and done.stdout.startswith('dashcalib ')


@pytest.mark.parametrize(('args', 'complaint'), [
    ([], 'COMMAND'),
    (['calibrate'], "invalid choice: 'calibrate'"),
    (['run'], 'INPUT'),
    (['run', 'x', '--fps', '0'], 'positive number'),
    (['run', 'x', '--fps', 'nan'], 'positive number'),
    (['run', 'x', '--turns', 'many'], '--turns'),
    (['run', 'x', '--thread', '2'], 'unrecognized'),
    (['compare', 'a'], 'B'),
])
def test_bad_usage_is_one_line(args, complaint):
    done = dashcalib(*args)
    assert_one_line_error(done)
    assert complaint in done.stderr and '--help' in done.stderr


def test_compare_shows_the_difference(results):
    done = dashcalib('compare', results / 'a', results / 'truth.json')
    assert (done.returncode, done.stderr) == (0, '')
    assert re.search(r'fx +721.54 px +714.54 px +\+7.0000 +\+0.980 % +2.0\n', done.stdout)
    assert 'mapping error: ' in done.stdout
    assert '\x1b' not in done.stdout


def test_compare_as_json(results):
    done = dashcalib('compare', results / 'a/calibration.yaml', results / 'truth.json', '--json')
    assert (done.returncode, done.stderr) == (0, '')
    data = json.loads(done.stdout)
    assert data['parameters']['fx']['difference'] == pytest.approx(7)
    assert data['parameters']['fx']['z'] == pytest.approx(2)
    assert 0 < data['mapping_px'] < 7
    assert data['a']['verdict'] == 'accepted'


@pytest.mark.parametrize('content', [None, b'', b'\x89junk\x00\xff', b'{}', b'fx: 3', b'[[['])
def test_compare_with_what_is_no_calibration(results, content):
    if content is not None:
        (results / 'b').write_bytes(content)
    assert_one_line_error(dashcalib('compare', results / 'a', results / 'b'))


def test_output_that_is_no_longer_read_is_no_error(results):
    reader, writer = os.pipe()
    os.close(reader)
    try:
        done = subprocess.run(
            [sys.executable, '-m', 'dashcalib_ros.cli', 'compare', results / 'a',
             results / 'truth.json', '--json'], stdout=writer, stderr=subprocess.PIPE, text=True)
    finally:
        os.close(writer)
    assert (done.returncode, done.stderr) == (0, '')


def test_a_terminal_that_knows_ascii_only_still_gets_the_numbers(results):
    done = dashcalib('compare', results / 'a', results / 'truth.json',
                     env={**os.environ, 'PYTHONIOENCODING': 'ascii'})
    assert done.returncode == 0 and '721.54 px' in done.stdout
