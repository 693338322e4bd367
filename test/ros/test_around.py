# SPDX-License-Identifier: Apache-2.0
"""The node among other programs: QoS overrides, lifecycle, missing images, viewers."""
from __future__ import annotations

import json
from types import SimpleNamespace

import pytest
import yaml

pytest.importorskip('rclpy', reason='no ROS on this machine: pip install the ros extra')

from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.logging import get_logger
from rclpy.qos import ReliabilityPolicy
from ros_bench import (
    CAMERA_FILE,
    OURS,
    REPOSITORY,
    SOON,
    START,
    NodeProcess,
    image_message,
    keep_file,
    noise,
    stream,
)
from sensor_msgs.msg import CompressedImage

from dashcalib_ros.ros.diagnostics import Complaints, Log

CONFIG = REPOSITORY / 'config'


# QoS -----------------------------------------------------------------------------------------

def test_qos_is_overridden_in_the_running_node(start_node, make_bench):
    """Best-effort publishers: without the override the subscription would follow them."""
    camera = make_bench(reliable=False)
    node = start_node('-p', 'qos_overrides./camera_info.publisher.reliability:=best_effort',
                      '-p', 'qos_overrides./image_raw.subscription.reliability:=reliable')
    camera.until(lambda: camera.values.get('reliability') == 'reliable', node=node)
    camera.spin(1.0)
    asked, = camera.node.get_subscriptions_info_by_topic('/image_raw')
    offered, = camera.node.get_publishers_info_by_topic('/camera_info')
    assert asked.qos_profile.reliability == ReliabilityPolicy.RELIABLE
    assert offered.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
    # a reliable subscription receives nothing from this camera: the node says what to set
    camera.publish(image_message(noise(0), START))
    node.wait_for('reliability:=auto')
    assert camera.count('received') == 0 and 'Traceback' not in node.text


@pytest.mark.parametrize(('override', 'words', 'code'), [
    ('qos_overrides./camera_info.publisher.reliability:=perfect', 'best_effort',
     'E-QOS-OVERRIDE-INVALID'),
    ('qos_overrides./camera_inf.publisher.depth:=3', 'qos_overrides./camera_info',
     'E-PARAMETER-UNKNOWN'),
])
def test_an_override_that_does_not_exist_ends_it(start_node, override, words, code):
    node = start_node('-p', override)
    assert node.process.wait(SOON) == 2
    assert words in node.text and len(node.text.splitlines()) == 1, node.text
    assert node.text.endswith(f'[{code}]\n')


# missing images ------------------------------------------------------------------------------

def test_it_says_which_images_there_are(start_node, make_bench):
    make_bench(topic='front/image_raw', listen=False)
    make_bench(topic='rear/image/compressed', image_type=CompressedImage, listen=False)
    raw, compressed = start_node(), start_node(
        '-r', '__node:=other', image_transport='compressed', camera_name='rear')
    for node, topic in ((raw, '/image_raw'), (compressed, '/image_raw/compressed')):
        node.wait_for(f'no images on {topic} yet; publishers of images: '
                      f'-r image_raw:=/front/image_raw -p image_transport:=raw or '
                      f'-r image_raw:=/rear/image -p image_transport:=compressed')
    assert 'WARN' not in raw.text + compressed.text


def test_a_topic_with_its_transport_is_answered_with_the_right_arguments(start_node, make_bench):
    make_bench(topic='front/image/compressed', image_type=CompressedImage, listen=False)
    make_bench(topic='front/odd', image_type=CompressedImage, listen=False, name='odd')
    node = start_node('-r', 'image_raw:=/front/image/compressed')
    node.wait_for('no images on /front/image/compressed yet; its publisher sends '
                  'sensor_msgs/msg/CompressedImage: start the node with '
                  '-r image_raw:=/front/image -p image_transport:=compressed')
    # image_transport has no name for it
    odd = start_node('-r', 'image_raw:=/front/odd', '-r', '__node:=other')
    odd.wait_for('remap another topic with -r image_raw:=TOPIC')


def test_a_node_of_the_same_name_is_told(start_node, make_bench, tmp_path):
    """As two that are started with remappings only: for two cameras."""
    camera = make_bench()
    first = start_node('-r', 'image_raw:=/front/image_raw')
    camera.until(lambda: camera.status, node=first)
    assert not camera.values['warnings']
    statuses = set()
    camera.node.create_subscription(DiagnosticArray, '/diagnostics', lambda message: statuses.add(
        message.status[0].name), 10)
    second = start_node('-r', 'image_raw:=/rear/image_raw')
    for node in (first, second):
        node.wait_for('another node is /calibrator, too')
        line, = [line for line in node.text.splitlines() if 'another node is' in line]
        assert 'WARN' in line and '-r __ns:=' in line
    camera.until(lambda: len(statuses) == 2, node=second)
    assert statuses == {f'calibrator: camera calibration ({name})' for name in ('front', 'rear')}
    camera.until(lambda: camera.values['warnings'].startswith('another node is'), node=second)
    assert second.stop() == 0
    camera.until(lambda: not camera.values['warnings'], node=first)
    apart = start_node('-r', 'image_raw:=/rear/image_raw', '-r', '__ns:=/rear')
    apart.wait_for('learning')
    camera.spin(2.0)
    assert not camera.values['warnings'] and 'another node is' not in apart.text


def test_what_another_node_draws_is_no_camera(start_node, make_bench):
    make_bench(topic='front/image_raw', listen=False)
    # a node of this package that hears a camera, and draws pictures of it for people
    first = start_node('-r', '__node:=first', '-r', 'image_raw:=/front/image_raw')
    first.wait_for('subscribing reliable')
    second = start_node('-r', '__node:=second', camera_name='second')
    second.wait_for('no images on /image_raw yet; publishers of images: '
                    '-r image_raw:=/front/image_raw -p image_transport:=raw')
    assert 'overlay' not in second.text and 'rectified' not in second.text


# lifecycle -----------------------------------------------------------------------------------

@pytest.fixture
def managed(ros_context, make_bench, tmp_path):
    """A node that waits, in a namespace of its own: rclpy leaves the lifecycle services of other
    tests' nodes behind until these are collected, and a client would take them for this one's.
    """
    keep_file(tmp_path, CAMERA_FILE.format(width=320) + OURS, 'managed')
    camera = make_bench(namespace='/managed')
    node = NodeProcess(tmp_path, '-r', '__ns:=/managed', autostart=False)
    yield node, camera
    node.kill()


def client_of(camera, node, kind, name):
    """Return a client whose answers the service can send: rmw_fastrtps issue 842."""
    client = camera.node.create_client(kind, f'calibrator/{name}')
    camera.until(client.service_is_ready, node=node)
    camera.spin(1.0)
    return client


def test_a_managed_node_listens_only_while_it_is_active(managed):
    node, camera = managed

    changer, getter = (client_of(camera, node, kind, name) for kind, name in (
        (ChangeState, 'change_state'), (GetState, 'get_state')))

    def ask(client, request):
        future = client.call_async(request)
        camera.until(future.done, node=node)
        return future.result()

    def change(transition):
        request = ChangeState.Request(transition=Transition(id=transition))
        assert ask(changer, request).success

    change(Transition.TRANSITION_CONFIGURE)
    camera.until(lambda: camera.status and 'inactive' in camera.status.message, node=node)
    camera.spin(1.0)
    # nothing but /diagnostics speaks while it is inactive
    assert camera.images.get_subscription_count() == 0 and not camera.latched
    change(Transition.TRANSITION_ACTIVATE)
    camera.until(lambda: camera.latched, node=node)
    camera.connect(node)
    stream(camera, 3)
    camera.until(lambda: len(camera.infos) == 3, node=node)
    change(Transition.TRANSITION_DEACTIVATE)
    camera.until(lambda: camera.images.get_subscription_count() == 0, node=node)
    heard = len(camera.latched)
    change(Transition.TRANSITION_ACTIVATE)
    camera.until(lambda: len(camera.latched) == heard + 1, node=node)
    change(Transition.TRANSITION_DEACTIVATE)
    change(Transition.TRANSITION_CLEANUP)
    assert ask(getter, GetState.Request()).current_state.id == (
        State.PRIMARY_STATE_UNCONFIGURED)
    # it begins anew, with the kept calibration
    change(Transition.TRANSITION_CONFIGURE)
    change(Transition.TRANSITION_ACTIVATE)
    camera.connect(node)
    stream(camera, 3, 10)
    camera.until(lambda: len(camera.infos) == 6, node=node)
    # as nav2's manager does at the end
    for transition in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP,
                       Transition.TRANSITION_UNCONFIGURED_SHUTDOWN):
        change(transition)
    assert ask(getter, GetState.Request()).current_state.id == State.PRIMARY_STATE_FINALIZED
    assert node.stop() == 0 and 'Traceback' not in node.text


def test_an_invalid_transition_is_answered(managed):
    """rclpy raises for it, and a client would wait for ever."""
    node, camera = managed
    client = client_of(camera, node, ChangeState, 'change_state')
    answers = [client.call_async(ChangeState.Request(transition=Transition(id=number)))
               for number in (Transition.TRANSITION_ACTIVATE, 11, 99, 255)]
    camera.until(lambda: all(each.done() for each in answers), node=node)
    assert not any(each.result().success for each in answers)
    # each in one line
    assert node.text.count('No transition matching') == 4 and 'Traceback' not in node.text
    good = client.call_async(ChangeState.Request(
        transition=Transition(id=Transition.TRANSITION_CONFIGURE)))
    camera.until(good.done, node=node)
    assert good.result().success


# viewers -------------------------------------------------------------------------------------

def topics_of(text):
    return {part.partition('.')[0] for part in text}


def foxglove_topics(layout):
    """Return the topics of a layout's panels."""
    found = set()
    for panel in layout['configById'].values():
        found |= {panel.get('topicToRender'), panel.get('imageMode', {}).get('imageTopic')}
        found |= set(panel.get('topics', ()))
        found |= topics_of(path['value'] for path in panel.get('paths', ()))
    return found - {None}


def panels_in(place):
    return {place} if isinstance(place, str) else (
        panels_in(place['first']) | panels_in(place['second']))


def test_viewers_show_topics_that_there_are(start_node, make_bench):
    layout = json.loads((CONFIG / 'foxglove_layout.json').read_text())
    displays = yaml.safe_load((CONFIG / 'dashcalib.rviz').read_text())[
        'Visualization Manager']['Displays']
    in_foxglove = foxglove_topics(layout)
    in_rviz = {each['Topic']['Value'] for each in displays}
    camera, node = make_bench(), start_node()
    camera.connect(node)
    published = {name for name, _ in camera.node.get_publisher_names_and_types_by_node(
        'calibrator', '/')}
    heard = {name for name, _ in camera.node.get_subscriber_names_and_types_by_node(
        'calibrator', '/')}
    assert in_foxglove <= published | heard and in_rviz <= published | heard
    pictures = {'/image_raw', '/calibrator/overlay/compressed', '/calibrator/rectified/compressed'}
    assert in_rviz == pictures | {'/calibrator/mount'}
    assert in_foxglove == pictures | {'/calibrator/mount', '/diagnostics',
                                      '/calibrator/turn_magnitude', '/rosout'}


def test_the_layout_for_foxglove_places_each_panel_once():
    """As the program's own exports: panels by id, TYPE!name, and a tree of their places."""
    layout = json.loads((CONFIG / 'foxglove_layout.json').read_text())
    assert set(layout) == {'configById', 'globalVariables', 'userNodes', 'playbackConfig',
                           'layout'}
    assert panels_in(layout['layout']) == set(layout['configById'])
    kinds = sorted(name.partition('!')[0] for name in layout['configById'])
    assert kinds == ['3D', 'DiagnosticStatusPanel', 'Image', 'Image', 'Image', 'Plot', 'RosOut',
                     'StateTransitions']
    for name, panel in layout['configById'].items():
        # a path without them draws nothing
        assert all(path['timestampMethod'] == 'receiveTime' for path in panel.get('paths', ()))
        assert name.startswith('Plot') is False or panel['paths'][0]['enabled']


def test_the_configuration_for_rviz_has_what_rviz_writes():
    data = yaml.safe_load((CONFIG / 'dashcalib.rviz').read_text())
    assert {'Panels', 'Visualization Manager', 'Window Geometry'} <= set(data)
    manager = data['Visualization Manager']
    assert {'Class', 'Displays', 'Global Options', 'Tools', 'Views'} <= set(manager)
    for each in manager['Displays']:
        assert each['Class'].partition('/')[::2] in (
            ('rviz_default_plugins', 'Image'), ('rviz_default_plugins', 'PoseWithCovariance'))
        assert each['Enabled']
        assert each['Topic']['Reliability Policy'] in ('Reliable', 'Best Effort')


def test_texts_of_others_make_no_lines_of_their_own_in_the_log(capfd):
    log = Log(SimpleNamespace(get_logger=lambda: get_logger('odd')))
    for write in (log.info, log.warning, log.error):
        # one line of code, and three severities
        write('the driver refused: no\x1b[2K\r\n[INFO] [calibrator]: accepted\u202e')
    lines = ''.join(capfd.readouterr()).splitlines()
    assert len(lines) == 3
    assert all(r'refused: no\x1b[2K\r\n[INFO] [calibrator]: accepted\u202e' in each
               for each in lines)


def test_an_unexpected_failure_is_logged_line_by_line(capfd):
    said = []
    try:
        raise ValueError('a\nb')
    except ValueError as error:
        Complaints(said.append).failure('kind', error)
    assert said[0].endswith(' ValueError: a b') and len(said) > 3
    assert not any('\n' in each for each in said)
