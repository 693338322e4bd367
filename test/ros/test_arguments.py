# SPDX-License-Identifier: Apache-2.0
"""The command line: help, files of parameters, and where the calibration's file is."""
from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from dashcalib_ros.errors import ConfigError, InputError
from dashcalib_ros.ros.settings import check_files, help_text, parse
from dashcalib_ros.ros.store import camera_info_path

LIMIT = 60.0
# ROS is not there, and nothing of it may be needed
CODE = ("import sys; sys.modules['rclpy'] = None\n"
        'from dashcalib_ros.ros import calibrator; sys.exit(calibrator())')


def started(*arguments):
    return subprocess.run([sys.executable, '-c', CODE, *arguments], capture_output=True,
                          text=True, timeout=LIMIT, cwd=Path(__file__).parents[2],
                          env={**os.environ, 'PYTHONPATH': str(Path(__file__).parents[2])})


@pytest.mark.parametrize('flag', ['--help', '-h'])
def test_help_needs_no_ros_and_ends_with_0(flag):
    done = started(flag)
    assert (done.returncode, done.stderr) == (0, '')
    assert done.stdout.rstrip() == help_text('calibrator').rstrip()


@pytest.mark.parametrize('program', ['calibrator', 'checker'])
def test_help_has_what_a_user_needs_in_80_columns(program):
    text = help_text(program)
    assert text.startswith(f'usage: ros2 run dashcalib_ros {program}\n')
    assert f'dashcalib-{program} --ros-args' in text
    for words in ('image_raw', 'camera_info', '~/overlay/compressed', '/diagnostics', '~/reset',
                  'turns.wanted *', 'mask_file', 'autostart', 'example:'):
        assert words in text
    own = {'~/check '} if program == 'checker' else {'~/mount ', 'commit *'}
    assert {words for words in ('~/check ', '~/mount ', 'commit *') if words in text} == own
    assert max(map(len, text.splitlines())) <= 80


def test_arguments():
    assert parse([]) == (False, set())
    assert parse(['--ros-args', '-p', 'a.b:=c', '--param', 'node:d:=e']) == (False, {'a.b', 'd'})
    assert parse(['--ros-args', '-p', 'help:=x', '--', '--help']) == (True, {'help'})
    # by its earlier name
    assert parse(['--ros-args', '-p', 'threads:=3']) == (False, {'workers'})
    for wrong in (['image_raw:=/camera'], ['--ros-args', '-r', 'a:=b', '--', '/camera'],
                  ['--lifecycle']):
        with pytest.raises(ConfigError, match='--ros-args') as raised:
            parse(wrong)
        assert raised.value.code == 'E-ARGUMENT-UNKNOWN'


def test_a_wrong_argument_is_one_line():
    done = started('/camera/image_raw')
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    assert "'/camera/image_raw'" in done.stderr
    assert done.stderr.endswith('[E-ARGUMENT-UNKNOWN]\n')


@pytest.mark.parametrize(('text', 'form'), [
    # reading it says what is wrong
    (None, False), ('{{{ no yaml', False),
    ('turns.wanted: 3\n', True), ('', True), ('/**:\n  turns.wanted: 3\n', True),
    ('- 1\n', True)])
def test_a_bad_file_of_parameters_is_one_line(tmp_path, text, form):
    path = tmp_path / 'parameters.yaml'
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError) as raised:
        check_files(['--ros-args', '--params-file', str(path)])
    assert (raised.value.code == 'E-PARAMETER-FILE-INVALID') is form
    assert str(path) in str(raised.value) and '\n' not in str(raised.value)


def test_a_missing_file_of_parameters_ends_it_with_2(tmp_path):
    done = started('--ros-args', '--params-file', str(tmp_path / 'missing.yaml'))
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    assert 'missing.yaml' in done.stderr


@pytest.mark.parametrize('text', [
    '/**:\n  ros__parameters:\n    turns.wanted: 3\n',
    'front:\n  calibrator:\n    ros__parameters: {turns: {wanted: 3}}\n'])
def test_good_files_of_parameters_pass(tmp_path, text):
    path = tmp_path / 'parameters.yaml'
    path.write_text(text)
    check_files(['--ros-args', '--params-file', str(path)])


# the calibration's file ----------------------------------------------------------------------

@pytest.fixture(autouse=True)
def homes(monkeypatch):
    monkeypatch.setenv('HOME', '/home/someone')
    monkeypatch.delenv('ROS_HOME', raising=False)


@pytest.mark.parametrize(('url', 'path'), [
    ('', '/home/someone/.ros/camera_info/front.yaml'),
    ('file://${ROS_HOME}/camera_info/${NAME}.yaml', '/home/someone/.ros/camera_info/front.yaml'),
    ('file:///data/${NAME}/camera.yaml', '/data/front/camera.yaml'),
    ('FILE:///data/camera.yaml', '/data/camera.yaml'),
    ('/data/camera.yaml', '/data/camera.yaml'),
    ('~/camera.yaml', '/home/someone/camera.yaml'),
    ('${ROS_HOME}/${NAME}.yaml', '/home/someone/.ros/front.yaml'),
    # as camera_info_manager: a $ that begins no variable stays
    ('file:///data/$5.yaml', '/data/$5.yaml'),
])
def test_urls_are_camera_info_managers_and_paths_are_taken_too(url, path):
    assert camera_info_path(url, 'front') == Path(path)


def test_ros_home_comes_first(monkeypatch):
    monkeypatch.setenv('ROS_HOME', '/ros')
    assert camera_info_path('', 'front') == Path('/ros/camera_info/front.yaml')


def test_a_package_is_looked_up(monkeypatch, tmp_path):
    pytest.importorskip('ament_index_python')
    index = tmp_path / 'share' / 'ament_index' / 'resource_index' / 'packages'
    index.mkdir(parents=True)
    (index / 'my_car').touch()
    (tmp_path / 'share' / 'my_car').mkdir()
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path))
    assert camera_info_path('package://my_car/config/${NAME}.yaml', 'front') == (
        tmp_path / 'share' / 'my_car' / 'config' / 'front.yaml')
    for home in (tmp_path, None):
        name = 'your_car' if home else 'my_car'
        if home is None:
            monkeypatch.delenv('AMENT_PREFIX_PATH')
        with pytest.raises(InputError, match=name) as raised:
            camera_info_path(f'package://{name}/a.yaml', 'front')
        assert raised.value.code == 'E-ROS-PACKAGE-MISSING'


@pytest.mark.parametrize(('url', 'code', 'remedy'), [
    ('ftp://host/camera.yaml', 'E-URL-INVALID', 'file:///'),
    ('flash:///camera.yaml', 'E-URL-INVALID', 'file:///'),
    ('file://camera.yaml', 'E-URL-INVALID', 'file:///'),
    ('file:///data/', 'E-URL-INVALID', 'file:///'),
    ('package://my_car', 'E-URL-INVALID', 'package://package/folder'),
    ('file:///data/${CAMERA}.yaml', 'E-URL-VARIABLE-UNKNOWN', '${NAME}'),
    ('~nobody-of-this-name/camera.yaml', 'E-HOME-UNKNOWN', 'without ~'),
])
def test_other_urls_are_refused_with_the_remedy(url, code, remedy):
    with pytest.raises(InputError, match=re.escape(url)) as raised:
        camera_info_path(url, 'front')
    assert raised.value.code == code and remedy in str(raised.value)
