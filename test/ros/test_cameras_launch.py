"""The launch file of several cameras. launch is not on the package index: where it is not
installed, replacements record what the file makes."""
from __future__ import annotations

import runpy
import sys
from pathlib import Path
from unittest.mock import MagicMock

import pytest

FILE = Path(__file__).resolve().parents[2] / 'launch' / 'cameras.launch.py'
MODULES = ('launch', 'launch.actions', 'launch.substitutions', 'launch_ros', 'launch_ros.actions',
           'launch_ros.substitutions')
TWO = 'front:=/front/image_raw rear:=/car/back/image_rect'


@pytest.fixture
def made(monkeypatch):
    """The file's functions, and what it calls."""
    modules = {name: MagicMock() for name in MODULES}
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    return runpy.run_path(str(FILE)), modules


def test_cameras_are_names_with_topics(made):
    cameras_in = made[0]['cameras_in']
    assert cameras_in(TWO) == {'front': '/front/image_raw', 'rear': '/car/back/image_rect'}
    assert cameras_in('  front:=image_raw ') == {'front': '/front/image_raw'}


@pytest.mark.parametrize('text', [
    '', 'front', 'front=/a', ':=/a', 'front:=', '1st:=/a', 'a/b:=/a', 'front:=/a b', 'f:=/a:=/b',
    'front:=/a front:=/b', 'front:=/a rear:=/a', 'front:=/a/image rear:=/a/image',
    'front:=image rear:=/front/image'])
def test_what_is_no_camera_is_refused(made, text):
    with pytest.raises(ValueError, match='camera'):
        made[0]['cameras_in'](text)


def test_each_camera_has_its_own_calibrator(made):
    functions, modules = made
    modules['launch.substitutions'].LaunchConfiguration.return_value.perform.return_value = TWO
    assert len(functions['calibrators'](object())) == 2
    front, rear = (call.kwargs for call in modules['launch_ros.actions'].Node.call_args_list)
    assert (front['package'], front['executable']) == ('dashcalib_ros', 'calibrator')
    assert [each['namespace'] for each in (front, rear)] == ['front', 'rear']
    # the same file of parameters, and after it what is the camera's own
    assert [each['parameters'][1]['camera_name'] for each in (front, rear)] == ['front', 'rear']
    assert dict(front['remappings']) == {'image_raw': '/front/image_raw',
                                         'camera_info': '/front/camera_info'}
    assert dict(rear['remappings']) == {'image_raw': '/car/back/image_rect',
                                        'camera_info': '/car/back/camera_info'}


def test_launch_itself_reads_it():
    pytest.importorskip('launch.actions', reason='launch is not installed')
    pytest.importorskip('launch_ros.actions', reason='launch_ros is not installed')
    from launch import LaunchContext
    functions = runpy.run_path(str(FILE))
    arguments = functions['generate_launch_description']().get_launch_arguments()
    assert [each.name for each in arguments] == [name for name, _, _ in functions['ARGUMENTS']]
    context = LaunchContext()
    context.launch_configurations['cameras'] = TWO
    assert len(functions['calibrators'](context)) == 2
