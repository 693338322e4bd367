# SPDX-License-Identifier: Apache-2.0
"""What is installed with the node: its parameters' file, profiles, launch files; colcon's view."""
from __future__ import annotations

import ast
import dataclasses
import importlib.util
import math
import os
import re
import shutil
import subprocess
import sys
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml

pytest.importorskip('rclpy', reason='no ROS on this machine: pip install the ros extra')

import rclpy
from ament_index_python import get_package_prefix, get_package_share_directory
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, ListParameters, SetParameters
from rclpy.node import Node, NodeNameNonExistentError
from ros_bench import LARGE_IMAGES, QUICK_COMMAND, REPOSITORY, SOON, Bench, NodeProcess

from dashcalib_ros.config import Config
from dashcalib_ros.ros.interface import (
    CALIBRATOR,
    OF_CAMERA,
    OF_RCLPY,
    PROGRAMS,
    PUBLISHED,
    SENSORS,
    SERVICES,
    SUBSCRIBED,
)
from dashcalib_ros.ros.parameters import declare, declared_names, given_parameters
from dashcalib_ros.ros.settings import CHANGEABLE, RIG_ONLY, NodeConfig, specs

COLCON = shutil.which('colcon')
place = importlib.util.spec_from_file_location(
    'docs_ros_interface', REPOSITORY / 'docs' / 'ros_interface.py')
docs = importlib.util.module_from_spec(place)
place.loader.exec_module(docs)
# one drive, and the node, have no use for the settings of a fleet and of a rig
CORE = {name: value for name, value in Config().flat().items()
        if not name.startswith(('fleet.', 'rig.'))}


@pytest.fixture(scope='module')
def node_and_bench(ros_context, tmp_path_factory):
    """A node with the shipped file of parameters."""
    node = NodeProcess(tmp_path_factory.mktemp('installed'), '--params-file',
                       str(REPOSITORY / 'config' / 'calibrator.yaml'))
    bench = Bench(ros_context, listen=True)
    try:
        bench.connect(node)
        yield node, bench
    finally:
        node.kill()
        bench.close()


def test_the_shipped_parameters_are_the_defaults():
    """If this fails: python docs/ros_interface.py."""
    text = (REPOSITORY / 'config' / 'calibrator.yaml').read_text()
    assert text == docs.sample()
    values = yaml.safe_load(text)['/**']['ros__parameters']
    own = {spec.name: spec.default for spec in dataclasses.fields(NodeConfig)
           if spec.name not in RIG_ONLY}
    experts = {name for name, spec in specs().items() if spec.metadata['expert']}
    expected = {name: value for name, value in {**CORE, **own}.items() if name not in experts}
    # NaN equals nothing
    assert repr(values) == repr({name: expected[name] for name in values})
    assert set(values) == set(expected)
    # those for experts are lines that are commented out
    commented = dict(re.findall(r'^    # ([a-z_.0-9]+): (\S+|\[.*\])$', text, re.MULTILINE))
    assert set(commented) == experts and len(values) < len(experts)
    assert float(commented['scene.loss_px']) == 0.5 and commented['queue_size'] == '10'


UNIT = re.compile(
    r'\b(px|m?s|k?Hz|m?m|km/h|m/s|rad(/s)?|degrees|ratio|share|fraction|factor|times|sigmas?|'
    r'deviations?|processes|contradictions|turns?|images?|frames?|points?|tracks?|iterations?|'
    r'steps?|rounds|pairs)\b|[°%]')


def test_each_number_has_its_unit():
    """In the last part of its name, or first in its reason."""
    for name, spec in specs().items():
        if type(spec.default) in (int, float) and name != 'seed':
            reason = spec.metadata['reason'].partition(';')[0]
            assert UNIT.search(reason) or UNIT.search(name.rpartition('_')[2]), name


def read(arguments):
    """Return the settings, and the names of parameters, of a node with these arguments."""
    rclpy.init(args=['calibrator', '--ros-args', *arguments])
    node = Node('read')
    try:
        return declare(node, CALIBRATOR, given_parameters('calibrator')), declared_names(node)
    finally:
        node.destroy_node()
        rclpy.shutdown()


def test_a_parameter_may_have_its_earlier_name(ros_context):
    with pytest.warns(FutureWarning, match='workers'):
        settings, names = read(['-p', 'threads:=3'])
    assert settings.core.workers == 3 and 'workers' in names and 'threads' not in names


def test_a_file_may_have_full_names_or_sections(tmp_path, ros_context):
    path = tmp_path / 'parameters.yaml'
    path.write_text('/**:\n  ros__parameters:\n    turns.wanted: 3\n    tracking.rate: 8.0\n'
                    '    turns:\n      at_most: 4\n')
    settings, _ = read(['--params-file', str(path)])
    assert settings.core == Config().replace(
        {'turns.wanted': 3, 'tracking.rate': 8.0, 'turns.at_most': 4})


def test_an_empty_list_of_another_node_is_left_alone(ros_context):
    settings, _ = read(['-p', 'filters:=[]', '-p', 'turns.wanted:=3', '-p', 'mount_x:=1'])
    assert settings.core.turns.wanted == 3 and settings.own.mount_x == 1.0


@pytest.mark.parametrize(('given', 'classes'), [
    ('[7, 13]', '7,13'), ('[13]', '13'), ('13', '13'), ("'63, 64'", '63, 64')])
def test_classes_are_an_array_of_integers(ros_context, given, classes):
    """Or, as up to version 0.2, a text."""
    name = 'mask.segmentation_classes'
    rclpy.init(args=['calibrator', '--ros-args', '-p', f'{name}:={given}'])
    node = Node('read')
    try:
        settings = declare(node, CALIBRATOR, given_parameters('calibrator'))
        assert settings.core.mask.segmentation_classes == classes
        assert list(node.get_parameter(name).value) == [int(n) for n in classes.split(',')]
    finally:
        node.destroy_node()
        rclpy.shutdown()


def test_what_is_not_known_can_be_said(ros_context):
    settings, _ = read(['-p', 'mount_x:=.nan', '-p', 'mount_y:=0.0'])
    own = settings.own
    assert math.isnan(own.mount_x) and own.mount_y == 0.0 and math.isnan(own.mount_z)


def test_a_file_of_all_nodes_may_have_their_parameters(tmp_path, start_node):
    path = tmp_path / 'parameters.yaml'
    path.write_text('/**:\n  ros__parameters:\n    turns.wanted: 3\n    max_speed: 8.0\n'
                    '    turns.at_mots: 4\n    qos_overrides./cmd_vel.publisher.depth: 3\n')
    node = start_node('--params-file', str(path))
    node.wait_for('learning the camera')
    line, = [line for line in node.text.splitlines() if 'WARN' in line]
    assert 'max_speed' in line and '/cmd_vel.' in line and 'turns.at_most?' in line
    assert node.stop() == 0


def test_the_node_takes_the_shipped_parameters(node_and_bench):
    node, _ = node_and_bench
    assert 'WARN' not in node.text and 'learning the camera' in node.text


def test_parameters_are_declared_with_type_reason_and_range(start_node, make_bench):
    node, bench = start_node('-r', '__node:=typed', scene__loss_px=0.6, mount_x=1), make_bench()
    request = ListParameters.Request(depth=0)
    names = list(ask(bench, node, ListParameters, '/typed/list_parameters', request).result.names)
    users = {name for name, spec in specs().items() if not spec.metadata['expert']}
    assert users < set(names)
    request = DescribeParameters.Request(names=names)
    about = {each.name: each for each in ask(
        bench, node, DescribeParameters, '/typed/describe_parameters', request).descriptors}
    kinds = {bool: ParameterType.PARAMETER_BOOL, int: ParameterType.PARAMETER_INTEGER,
             float: ParameterType.PARAMETER_DOUBLE, str: ParameterType.PARAMETER_STRING}
    for name in users:
        assert about[name].description and not about[name].dynamic_typing
        assert about[name].type == kinds[type(specs()[name].default)], name
    assert {name for name in about if not about[name].read_only} - {'use_sim_time'} == set(
        CHANGEABLE)
    assert about['scene.loss_px'].description.endswith('(for experts)')
    assert 'experts' not in about['turns.wanted'].description
    speed = about['mount.speed_kmh'].floating_point_range[0]
    assert (speed.from_value, speed.to_value) == (0.0, 300.0)
    wanted = about['turns.wanted'].integer_range[0]
    assert (wanted.from_value, wanted.to_value) == (1, 20)
    assert 'crop' in about['rectified'].additional_constraints
    assert 'fisheye' in about['model'].description


def test_what_users_set_fits_a_screen(ros_context):
    """Settings for experts are parameters where they are given."""
    settings, names = read(['-p', 'scene.loss_px:=0.6'])
    assert settings.core.scene.loss_px == 0.6 and 'scene.loss_px' in names
    assert {name for name, spec in specs().items() if not spec.metadata['expert']} < set(names)
    assert len(names) <= 50 and 'scene.error_px' not in names


@pytest.mark.parametrize('program', ['calibrator', 'checker'])
def test_the_page_of_the_interface_is_that_of_a_running_node(start_node, make_bench, program):
    """If this fails: python docs/ros_interface.py."""
    assert (REPOSITORY / 'docs' / 'ros_interface.md').read_text() == docs.page()
    node, bench = start_node(command=[*QUICK_COMMAND, program]), make_bench(listen=False)
    bench.until(lambda: bench.images.get_subscription_count() > 0
                and program in bench.node.get_node_names(), node=node)

    def full(name):
        return '/' + name.replace('~', program).lstrip('/')

    def found(kind):
        # now and then the node is in one list of the graph and not yet in the other
        with suppress(NodeNameNonExistentError):
            return dict(getattr(bench.node, f'get_{kind}_names_and_types_by_node')(program, '/'))
        return {}

    def expected(table):
        # tf2 and the sensors: with parameters; of a video, the type is another
        return {full(name): [topic.type] for name, topic in table.items()
                if program in topic.programs and name not in ('/tf_static', *SENSORS)}

    of_rclpy = {full(name) for name in OF_RCLPY['topics']}
    # the node's own lists come one after the other, a moment later
    bench.until(lambda: found('publisher').keys() >= expected(PUBLISHED).keys()
                and found('subscriber').keys() >= expected(SUBSCRIBED).keys()
                and len(found('service')) >= len(OF_RCLPY['services']), node=node)
    bench.spin(0.5)
    said, heard = found('publisher'), found('subscriber')
    assert of_rclpy < set(said)
    assert {name: said[name] for name in set(said) - of_rclpy} == expected(PUBLISHED)
    heard.pop('/parameter_events', None)
    assert heard == expected(SUBSCRIBED)
    names = set(ask(bench, node, ListParameters, f'/{program}/list_parameters',
                    ListParameters.Request(depth=0)).result.names)
    for kind, topics in (('publisher', expected(PUBLISHED)), ('subscription', heard)):
        for topic in topics:
            assert f'qos_overrides.{topic}.{kind}.depth' in names
    assert set(found('service')) == {
        full(each.name) for each in SERVICES if program in each.programs} | {
        full(name) for name in OF_RCLPY['services']}


def test_parameters_that_may_not_change_say_so(node_and_bench):
    node, bench = node_and_bench
    def set_to(name, **value):
        request = SetParameters.Request(parameters=[Parameter(
            name=name, value=ParameterValue(**value))])
        return ask(bench, node, SetParameters, 'set_parameters', request).results[0]

    whole = ParameterType.PARAMETER_INTEGER
    refused = set_to('turns.at_most', type=whole, integer_value=3)
    assert not refused.successful and '-p turns.at_most:=VALUE' in refused.reason
    assert refused.reason.endswith('[E-PARAMETER-READ-ONLY]')
    # the same as at the start
    for name, near in (('turns.wnted', 'turns.wanted?'), ('of_another_node', 'no parameter')):
        refused = set_to(name, type=whole, integer_value=3)
        assert not refused.successful and name in refused.reason and near in refused.reason
        assert refused.reason.endswith('[E-PARAMETER-UNKNOWN]')
    refused = set_to('queue_size', type=whole, integer_value=3)
    assert not refused.successful and '-p queue_size:=VALUE' in refused.reason
    refused = set_to('turns.wanted', type=whole, integer_value=11)
    assert not refused.successful and '-p turns.wanted:=11' in refused.reason
    assert refused.reason.endswith('[E-TURNS-ABOVE-CAPACITY]')
    for value in (3, 5):
        assert set_to('turns.wanted', type=whole, integer_value=value).successful
        bench.until(lambda value=value: bench.count('turns wanted') == value, node=node)
    text = ParameterType.PARAMETER_STRING
    for name, value in (('model', 'fisheye'), ('model', 'mirror'), ('rectified', 'crop')):
        refused = set_to(name, type=text, string_value=value)
        assert not refused.successful and '[E-PARAMETER-READ-ONLY]' in refused.reason
        assert '\n' not in refused.reason
    refused = set_to('commit', type=whole, integer_value=3)
    assert not refused.successful and 'type' in refused.reason
    assert set_to('commit', type=ParameterType.PARAMETER_BOOL, bool_value=True).successful
    assert set_to('commit', type=ParameterType.PARAMETER_BOOL, bool_value=False).successful


def ask(bench, node, kind, name, request):
    client = bench.node.create_client(
        kind, name if name.startswith('/') else f'calibrator/{name}')
    bench.until(client.service_is_ready, what=name, node=node)
    future = client.call_async(request)
    bench.until(future.done, what=name, node=node)
    return future.result()


def test_the_permissions_are_what_the_nodes_use():
    """No more than the table of the interface, which is compared with running nodes, and no less.

    The video's topics depend on parameters.
    """
    policy = ElementTree.parse(REPOSITORY / 'config' / 'sros2_policy.xml')
    for program in PROGRAMS:
        rest = {'/clock', *(['image_raw/compressed'] if program in OF_CAMERA else [])}
        profile = policy.find(f".//profile[@node='{program}']")

        def allowed(kind, access, profile=profile):
            return {each.text for each in profile.findall(f"{kind}s[@{access}='ALLOW']/{kind}")}

        def of(table, program=program):
            return {name for name, topic in table.items() if program in topic.programs}

        assert allowed('topic', 'publish') == of(PUBLISHED) | set(OF_RCLPY['topics'])
        assert allowed('topic', 'subscribe') == of(SUBSCRIBED) | rest
        assert allowed('service', 'reply') == set(OF_RCLPY['services']) | {
            each.name for each in SERVICES if program in each.programs}
        assert allowed('service', 'request') == (
            {'set_camera_info'} if program == 'calibrator' else set())


def test_the_permissions_have_the_form_that_sros2_takes():
    """Its schema: policy 0.2.0, enclaves, profiles, then lists of names with one access each."""
    policy = ElementTree.parse(REPOSITORY / 'config' / 'sros2_policy.xml').getroot()
    assert (policy.tag, policy.attrib) == ('policy', {'version': '0.2.0'})
    enclave, *others = policy.findall('enclaves/enclave')
    assert [each.get('path') for each in others] == [
        '/dashcalib_ros/checker', '/dashcalib_ros/rig']
    assert [each.tag for each in policy.iter()][:5] == [
        'policy', 'enclaves', 'enclave', 'profiles', 'profile']
    assert enclave.get('path').startswith('/')
    profile, = enclave.findall('profiles/profile')
    assert profile.attrib == {'ns': '/', 'node': 'calibrator'}
    kinds = {'topics': ('topic', {'publish', 'subscribe'}),
             'services': ('service', {'request', 'reply'})}
    for rule in profile:
        kind, accesses = kinds[rule.tag]
        assert set(rule.attrib) <= accesses and set(rule.attrib.values()) == {'ALLOW'}
        assert len(rule) and all(each.tag == kind and each.text.strip() == each.text
                                 for each in rule)


def test_the_large_image_profile_carries_best_effort_images(tmp_path, node_and_bench):
    """A camera process with the profile: 1280x720 bgr8 at 30 Hz, best effort."""
    node, bench = node_and_bench
    camera = f"""
import sys, time
sys.path.insert(0, {str(REPOSITORY / 'testing')!r})
import numpy as np, rclpy
from ros_bench import START, Bench, image_message
context = rclpy.Context()
rclpy.init(context=context)
bench = Bench(context, reliable=False, listen=False)
picture = np.zeros((720, 1280, 3), np.uint8)
bench.until(lambda: bench.images.get_subscription_count() > 0)
time.sleep(2)
for n in range(60):
    bench.images.publish(image_message(picture, START + n * 10**9 // 30))
    time.sleep(1 / 30)
bench.spin(2)
"""
    before = bench.count('received')
    done = subprocess.run(
        [sys.executable, '-c', camera], capture_output=True, text=True, timeout=2 * SOON,
        env={**os.environ, **LARGE_IMAGES})
    assert done.returncode == 0 and 'XML' not in done.stdout + done.stderr, done.stderr
    # without the profile 4 of these 60 arrive
    bench.until(lambda: bench.count('received') - before >= 45, what='45 of 60 images', node=node)


def test_the_launch_file_starts_a_crashed_node_again_with_a_limit():
    """It is read, not run: launch is not on the package index. The others include it."""
    code = ast.parse((REPOSITORY / 'launch' / 'calibrator.launch.py').read_text())
    call = next(each for each in ast.walk(code) if isinstance(each, ast.Call)
                and isinstance(each.func, ast.Name) and each.func.id == 'LifecycleNode')
    given = {each.arg: each.value for each in call.keywords}
    assert given['package'].value == 'dashcalib_ros'
    assert (given['respawn'].value, given['respawn_delay'].value,
            given['respawn_max_retries'].value) == (True, 2.0, 5)
    for other in ('cameras', 'calibrator_lifecycle'):
        text = (REPOSITORY / 'launch' / f'{other}.launch.py').read_text()
        assert "'calibrator.launch.py'" in text and 'IncludeLaunchDescription(' in text


def test_the_launch_file_in_xml_is_the_other_one():
    root = ElementTree.parse(REPOSITORY / 'launch' / 'calibrator.launch.xml').getroot()
    include, = root
    assert include.get('file').endswith('/launch/calibrator.launch.py')


def test_programs_are_where_ros2_run_looks():
    for program in PROGRAMS:
        path = REPOSITORY / 'scripts' / program
        assert os.access(path, os.X_OK)
        done = subprocess.run([sys.executable, str(path), '--help'], capture_output=True,
                              text=True, timeout=SOON, env={
                                  **os.environ, 'PYTHONPATH': str(REPOSITORY)})
        assert done.stdout.startswith(f'usage: ros2 run dashcalib_ros {program}\n')


@pytest.mark.parametrize('command', ['dashcalib', 'dashcalib-calibrator', 'dashcalib-checker',
                                     'dashcalib-rig'])
def test_pip_puts_the_commands_beside_python(command):
    """An old pip without pyproject.toml puts them where setup.cfg tells colcon to."""
    places = [Path(str(each.locate_file('')))
              for each in metadata.distributions(name='dashcalib_ros')]
    if not any(place.is_relative_to(sys.prefix) for place in places):
        pytest.skip('pip has not installed it here: the tests run from the sources')
    assert os.access(Path(sys.executable).parent / command, os.X_OK)


@pytest.mark.skipif(COLCON is None, reason='no colcon: pip install colcon-ros and friends')
def test_colcon_builds_it_and_ros2_run_would_find_it(tmp_path, monkeypatch):
    for name in ('dashcalib_ros', 'config', 'launch', 'resource', 'scripts'):
        shutil.copytree(REPOSITORY / name, tmp_path / 'src' / name,
                        ignore=shutil.ignore_patterns('__pycache__'))
    for name in ('setup.py', 'setup.cfg', 'pyproject.toml', 'package.xml', 'LICENSE', 'README.md'):
        if (REPOSITORY / name).exists():
            shutil.copy(REPOSITORY / name, tmp_path / 'src' / name)
    # on an apt ROS, colcon runs in the interpreter that has ROS; here it may have its own
    done = subprocess.run([COLCON, 'build'], cwd=tmp_path, capture_output=True, text=True,
                          timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    prefix = tmp_path / 'install' / 'dashcalib_ros'
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(prefix))
    assert Path(get_package_prefix('dashcalib_ros')) == prefix
    share = Path(get_package_share_directory('dashcalib_ros'))
    assert sorted(path.name for path in (share / 'config').iterdir()) == [
        'calibrator.yaml', 'dashcalib.rviz', 'fastdds_large_images.xml', 'foxglove_layout.json',
        'sros2_policy.xml']
    assert sorted(path.name for path in (share / 'launch').iterdir()) == [
        'calibrator.launch.py', 'calibrator.launch.xml', 'calibrator_lifecycle.launch.py',
        'cameras.launch.py']
    executable = prefix / 'lib' / 'dashcalib_ros' / 'calibrator'
    assert os.access(executable, os.X_OK)
    site = next(prefix.glob('lib/python*/site-packages'))
    node = NodeProcess(tmp_path, command=[sys.executable, str(executable)],
                       python_path=str(site))
    try:
        node.wait_for('learning the camera')
        assert node.stop() == 0, node.text
    finally:
        node.kill()
