"""What is installed with the node: its parameters' file, profiles, launch files; colcon's view."""
from __future__ import annotations

import ast
import dataclasses
import os
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml

pytest.importorskip('rclpy', reason='no ROS on this machine: pip install the ros extra')

from ament_index_python import get_package_prefix, get_package_share_directory
from rcl_interfaces.srv import DescribeParameters, ListParameters
from rclpy.node import Node
from ros_bench import REPOSITORY, SOON, Bench, NodeProcess

from dashcalib_ros.config import Config, describe
from dashcalib_ros.ros.parameters import declare
from dashcalib_ros.ros.settings import CHANGEABLE, NodeConfig, sample

COLCON = shutil.which('colcon')
# one drive, and the node, have no use for a fleet's settings
CORE = {name: value for name, value in Config().flat().items() if not name.startswith('fleet.')}


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
    """If this fails: python -m dashcalib_ros.ros.settings > config/calibrator.yaml."""
    text = (REPOSITORY / 'config' / 'calibrator.yaml').read_text()
    assert text == sample()
    values = yaml.safe_load(text)['/**']['ros__parameters']
    own = {spec.name: spec.default for spec in dataclasses.fields(NodeConfig)}
    assert values == {**CORE, **own}


def test_the_shipped_parameters_list_what_users_set_first():
    users, experts = sample().split('For experts')
    assert 'turns.wanted: 5' in users and 'camera_name:' in users
    assert 'scene.loss_px: 0.5' in experts and 'queue_size: 10' in experts
    both = [spec.metadata['expert'] for _, spec in describe()]
    both += [spec.metadata['expert'] for spec in dataclasses.fields(NodeConfig)]
    values = yaml.safe_load(users.removesuffix('# '))['/**']['ros__parameters']
    assert len(values) == both.count(False) <= 25 < both.count(True)


def test_a_file_may_have_full_names_or_sections(tmp_path, ros_context):
    path = tmp_path / 'parameters.yaml'
    path.write_text('/**:\n  ros__parameters:\n    turns.wanted: 3\n    motion.rate: 8.0\n'
                    '    turns:\n      at_most: 4\n')
    node = Node('read', context=ros_context, cli_args=['--ros-args', '--params-file', str(path)])
    try:
        core, _ = declare(node)
    finally:
        node.destroy_node()
    assert core == Config().replace({'turns.wanted': 3, 'motion.rate': 8.0, 'turns.at_most': 4})


def test_the_node_takes_the_shipped_parameters(node_and_bench):
    node, _ = node_and_bench
    assert 'WARN' not in node.text and 'learning the camera' in node.text


def test_every_parameter_is_declared_with_its_reason_and_range(node_and_bench):
    node, bench = node_and_bench
    request = ListParameters.Request(depth=0)
    names = list(ask(bench, node, ListParameters, 'list_parameters', request).result.names)
    assert set(CORE) <= set(names)
    request = DescribeParameters.Request(names=names)
    about = {each.name: each for each in ask(
        bench, node, DescribeParameters, 'describe_parameters', request).descriptors}
    assert all(about[name].description for name in CORE)
    assert {name for name in about if not about[name].read_only} - {'use_sim_time'} == set(
        CHANGEABLE)
    assert about['scene.loss_px'].description.endswith('(for experts)')
    assert 'experts' not in about['turns.wanted'].description
    half_width = about['turns.half_width'].floating_point_range[0]
    assert (half_width.from_value, half_width.to_value) == (0.5, 10.0)
    wanted = about['turns.wanted'].integer_range[0]
    assert (wanted.from_value, wanted.to_value) == (1, 20)
    assert 'best_effort' in about['reliability'].additional_constraints
    assert 'crop' in about['rectified'].additional_constraints
    assert 'fisheye' in about['model'].description


def test_what_users_set_fits_a_screen(ros_context):
    """Settings for experts are parameters where they are given."""
    node = Node('read', context=ros_context, cli_args=['--ros-args', '-p', 'scene.loss_px:=0.6'])
    try:
        core, _ = declare(node)
        names = set(node._parameters)
    finally:
        node.destroy_node()
    assert core.scene.loss_px == 0.6 and 'scene.loss_px' in names
    assert {name for name, spec in describe() if not spec.metadata['expert']} < names
    assert len(names) <= 50 and 'scene.error_px' not in names


def test_parameters_that_may_not_change_say_so(node_and_bench):
    node, bench = node_and_bench
    from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
    from rcl_interfaces.srv import SetParameters

    def set_to(name, **value):
        request = SetParameters.Request(parameters=[Parameter(
            name=name, value=ParameterValue(**value))])
        return ask(bench, node, SetParameters, 'set_parameters', request).results[0]

    whole = ParameterType.PARAMETER_INTEGER
    refused = set_to('turns.at_most', type=whole, integer_value=3)
    assert not refused.successful and '-p turns.at_most:=VALUE' in refused.reason
    assert refused.reason.endswith('[E-PARAMETER-READ-ONLY]')
    # the same as at the start
    for name, near in (('turns.wnted', 'turns.wanted'), ('of_another_node', '/**')):
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
    assert not refused.successful and 'commit must be bool' in refused.reason
    assert set_to('commit', type=ParameterType.PARAMETER_BOOL, bool_value=True).successful
    assert set_to('commit', type=ParameterType.PARAMETER_BOOL, bool_value=False).successful


def ask(bench, node, kind, name, request):
    client = bench.node.create_client(kind, f'calibrator/{name}')
    bench.until(client.service_is_ready, what=name, node=node)
    future = client.call_async(request)
    bench.until(future.done, what=name, node=node)
    return future.result()


def test_the_permissions_are_what_the_node_uses(node_and_bench):
    """No more than the live node's own endpoints, and no less, the optional ones aside."""
    _, bench = node_and_bench
    policy = ElementTree.parse(REPOSITORY / 'config' / 'sros2_policy.xml')
    seen = bench.node

    def allowed(kind, access):
        found = policy.findall(f".//{kind}s[@{access}='ALLOW']/{kind}")
        return {'/' + each.text.replace('~', 'calibrator').lstrip('/') for each in found}

    def used(function):
        return {name for name, _ in getattr(seen, function)('calibrator', '/')}

    # ~/check: with check_only, test_check_only.py has it; /tf_static: with publish_tf
    assert used('get_publisher_names_and_types_by_node') == (
        allowed('topic', 'publish') - {'/calibrator/check', '/tf_static'})
    heard = used('get_subscriber_names_and_types_by_node')
    assert heard <= allowed('topic', 'subscribe') and '/image_raw' in heard
    assert used('get_service_names_and_types_by_node') == allowed('service', 'reply')
    assert used('get_client_names_and_types_by_node') <= allowed('service', 'request')


def test_the_permissions_have_the_form_that_sros2_takes():
    """Its schema: policy 0.2.0, enclaves, profiles, then lists of names with one access each."""
    policy = ElementTree.parse(REPOSITORY / 'config' / 'sros2_policy.xml').getroot()
    assert (policy.tag, policy.attrib) == ('policy', {'version': '0.2.0'})
    enclave, = policy.findall('enclaves/enclave')
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
sys.path.insert(0, {str(REPOSITORY / 'test')!r})
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
    profile = REPOSITORY / 'config' / 'fastdds_large_images.xml'
    done = subprocess.run(
        [sys.executable, '-c', camera], capture_output=True, text=True, timeout=2 * SOON,
        env={**os.environ, 'FASTRTPS_DEFAULT_PROFILES_FILE': str(profile)})
    assert done.returncode == 0 and 'XML' not in done.stdout + done.stderr, done.stderr
    # without the profile 4 of these 60 arrive
    bench.until(lambda: bench.count('received') - before >= 45, what='45 of 60 images', node=node)


def test_launch_files_start_the_node_with_the_same_arguments():
    tree = ElementTree.parse(REPOSITORY / 'launch' / 'calibrator.launch.xml')
    root = tree.getroot()
    code = ast.parse((REPOSITORY / 'launch' / 'calibrator.launch.py').read_text())
    table = next(each.value for each in code.body if isinstance(each, ast.Assign)
                 and each.targets[0].id == 'ARGUMENTS')
    names = [row.elts[0].value for row in table.elts]
    assert names == [each.get('name') for each in root.findall('arg')]
    start = root.find('node')
    assert (start.get('pkg'), start.get('exec')) == ('dashcalib_ros', 'calibrator')
    # a node that crashed comes back, from either file
    assert (start.get('respawn'), start.get('respawn_delay')) == ('true', '2.0')
    call = next(each for each in ast.walk(code) if isinstance(each, ast.Call)
                and isinstance(each.func, ast.Name) and each.func.id == 'Node')
    given = {each.arg: each.value for each in call.keywords}
    assert (given['respawn'].value, given['respawn_delay'].value) == (True, 2.0)


@pytest.mark.parametrize('command', ['dashcalib', 'calibrator'])
def test_pip_puts_the_commands_beside_python(command):
    """An old pip without pyproject.toml puts them where setup.cfg tells colcon to."""
    places = [Path(str(each.locate_file('')))
              for each in metadata.distributions(name='dashcalib_ros')]
    if not any(place.is_relative_to(sys.prefix) for place in places):
        pytest.skip('pip has not installed it here: the tests run from the sources')
    assert os.access(Path(sys.executable).parent / command, os.X_OK)


@pytest.mark.skipif(COLCON is None, reason='no colcon: pip install colcon-ros and friends')
def test_colcon_builds_it_and_ros2_run_would_find_it(tmp_path, monkeypatch):
    for name in ('dashcalib_ros', 'config', 'launch', 'resource'):
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
        'calibrator.launch.py', 'calibrator.launch.xml']
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
