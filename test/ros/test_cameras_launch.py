# SPDX-License-Identifier: Apache-2.0
"""The launch file of several cameras. launch is not on the package index: where it is not
installed, replacements record what the file makes."""
from __future__ import annotations

import runpy
import sys
from pathlib import Path
from unittest.mock import MagicMock

import pytest

FILE = Path(__file__).resolve().parents[2] / 'launch' / 'cameras.launch.py'
ONE = FILE.with_name('calibrator.launch.py')
MODULES = ('launch', 'launch.actions', 'launch.conditions', 'launch.event_handlers',
           'launch.events', 'launch.launch_description_sources', 'launch.substitutions',
           'launch_ros', 'launch_ros.actions', 'launch_ros.event_handlers',
           'launch_ros.events', 'launch_ros.events.lifecycle', 'launch_ros.substitutions')
TWO = 'front:=/front/image_raw rear:=/car/back/image_rect'


@pytest.fixture
def made(monkeypatch):
    """The file's functions, and what it calls."""
    return run(FILE, monkeypatch)


def run(path, monkeypatch):
    modules = {name: MagicMock() for name in MODULES}
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    return runpy.run_path(str(path)), modules


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


def given(modules, **values):
    modules['launch.substitutions'].LaunchConfiguration.side_effect = (
        lambda name: MagicMock(**{'perform.return_value': values.get(name, '')}))


@pytest.mark.parametrize('rig', ['true', 'false'])
def test_each_camera_has_its_own_calibrator(made, monkeypatch, rig):
    functions, modules = made
    given(modules, cameras=TWO, rig=rig, stores='/data', odom='/car/odom')
    assert len(functions['calibrators'](object())) == 2 + (rig == 'true')
    front, rear = (dict(call.kwargs['launch_arguments']) for call in
                   modules['launch.actions'].IncludeLaunchDescription.call_args_list)
    stores = [each.pop('store', None) for each in (front, rear)]
    assert stores == (['/data/front', '/data/rear'] if rig == 'true' else [None, None])
    assert front == {'namespace': 'front', 'camera_name': 'front', 'image': '/front/image_raw',
                     'camera_info': '/front/camera_info'}
    assert rear == {'namespace': 'rear', 'camera_name': 'rear', 'image': '/car/back/image_rect',
                    'camera_info': '/car/back/camera_info'}
    nodes = [call.kwargs for call in modules['launch_ros.actions'].LifecycleNode.call_args_list]
    assert [(each['executable'], each['parameters'], each['remappings']) for each in nodes] == [
        ('rig', [{'cameras': 'front rear', 'stores': '/data', 'use_odom': True}],
         [('odom', '/car/odom')])] * (rig == 'true')
    # they are arguments of the file that is included
    names = {name for name, _, _ in run(ONE, monkeypatch)[0]['ARGUMENTS']}
    assert {'store', *front} < names


def test_one_camera_is_no_rig(made):
    functions, modules = made
    given(modules, cameras='front:=/front/image_raw', rig='true', stores='/data')
    assert len(functions['calibrators'](object())) == 1


@pytest.mark.parametrize('name', ['', 'roof'])
def test_one_calibrator_has_what_its_camera_has_alone(monkeypatch, name):
    functions, modules = run(ONE, monkeypatch)
    given(modules, camera_name=name, store=name and '/data/roof')
    assert functions['started'](object())[-1] is (
        modules['launch_ros.actions'].LifecycleNode.return_value)
    node, = (call.kwargs for call in modules['launch_ros.actions'].LifecycleNode.call_args_list)
    # an empty one would override that of the parameter file
    own = node['parameters'][1]
    assert own.get('camera_name', '') == name and ('camera_name' in own) is bool(name)
    assert own.get('turns.store') == ('/data/roof' if name else None)
    assert set(own) - {'camera_name', 'turns.store'} == {
        'image_transport', 'use_sim_time', 'autostart'}
    assert [each[0] for each in node['remappings']] == ['image_raw', 'camera_info']


def test_launch_itself_reads_it():
    pytest.importorskip('launch.actions', reason='launch is not installed')
    pytest.importorskip('launch_ros.actions', reason='launch_ros is not installed')
    from launch import LaunchContext
    functions = runpy.run_path(str(FILE))
    arguments = functions['generate_launch_description']().get_launch_arguments()
    assert [each.name for each in arguments] == ['cameras', 'rig', 'stores', 'odom']
    context = LaunchContext()
    context.launch_configurations |= {'cameras': TWO, 'rig': 'true', 'stores': '/s', 'odom': ''}
    assert len(functions['calibrators'](context)) == 3
