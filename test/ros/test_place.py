# SPDX-License-Identifier: Apache-2.0
"""The node that places the cameras of one car: stores of turns in, a rig out, a move by name."""
from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from made_rig import seen_rig
from solving import scenes_of
from synthetic import SIZE
from waiting import wait_for

pytest.importorskip('rclpy', reason='no ROS on this machine: pip install the ros extra')

from diagnostic_msgs.msg import DiagnosticArray
from fake_endpoints import FakeEndpoints, transforms
from rclpy.node import NodeNameNonExistentError
from rclpy.qos import DurabilityPolicy, QoSProfile
from ros_bench import QUICK_COMMAND
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header, String

from dashcalib_ros.config import Config
from dashcalib_ros.errors import ConfigError, Notice
from dashcalib_ros.formats.rig import load_rig
from dashcalib_ros.rig.placed import RigCalibration, not_placed
from dashcalib_ros.ros import place
from dashcalib_ros.ros.diagnostics import ERROR, OK, WARN
from dashcalib_ros.ros.interface import OF_RCLPY, PUBLISHED, SERVICES, SUBSCRIBED
from dashcalib_ros.ros.place import Placing
from dashcalib_ros.ros.settings import NodeConfig, Settings
from dashcalib_ros.store.scene_file import Origin, SceneFile, StoredTurn, encoded
from dashcalib_ros.workers.worker import InlineWorker

NAMES = ('front', 'left', 'rear')
BEGIN_S = 1.7e9
# with little noise, as a rotation is known no better than both lenses
SCENE, = scenes_of(1, noise_px=0.1)


def store(folder, name, *stamps_s, prominence=0.03, frame_id=None):
    """Write turns as a calibrator does; return their files."""
    (folder / name).mkdir(exist_ok=True)
    files = []
    for stamp_s in stamps_s:
        files.append(folder / name / f'turn-{int(10 * stamp_s):016x}.npz')
        tracks = replace(SCENE.tracks, stamps_ns=(
            SCENE.tracks.stamps_ns + round((BEGIN_S + stamp_s) * 1e9)))
        files[-1].write_bytes(encoded(SceneFile(
            Origin(SIZE, frame_id=f'{name}_optical' if frame_id is None else frame_id), (
                StoredTurn(replace(SCENE, tracks=tracks), BEGIN_S + stamp_s, prominence),), 1)))
    return files


class Place:
    """The program without ROS's graph; rigs: what each of its solutions gives."""

    def __init__(self, folder, monkeypatch, *rigs, names=NAMES, lenses=NAMES):
        self.rigs, self.asked = list(rigs), []

        def solved(*given):
            self.asked.append(given)
            return self.rigs.pop(0)

        monkeypatch.setattr(place, 'SETTLED_S', 0.0)
        monkeypatch.setattr(place, 'ChildWorker', lambda *options: InlineWorker())
        monkeypatch.setattr(place, 'rig_of_scenes', solved)
        self.endpoints = FakeEndpoints(None, None, None, {})
        self.placing = Placing(self.endpoints, Settings(Config(), NodeConfig(
            cameras=' '.join(names), stores=str(folder))), '')
        self.placing.inputs.start()
        self.lenses(*(name for name in lenses if name in names))

    def lenses(self, *names):
        for name in names:
            self.endpoints.heard[f'{name}/calibrator/calibration'](CameraInfo(
                header=Header(frame_id=f'{name}_optical'), k=[400.0, *[0.0] * 8]))

    def step(self):
        """Look at the stores; wait for the rig that is solved then, if one is."""
        self.placing.inputs.look()
        self.placing.advance()
        if self.placing._call is not None:
            wait_for(lambda: self.placing._call.done)
            self.placing.advance()
        self.placing._show_transforms()
        return self.placing._state()[:2]

    @property
    def published(self):
        return [json.loads(message.data) for topic, message in self.endpoints.published
                if topic == '~/result']

    def close(self):
        for end in self.endpoints.ends:
            end()


@pytest.fixture
def made(tmp_path, monkeypatch):
    found = []

    def make(*rigs, **options):
        found.append(Place(tmp_path, monkeypatch, *rigs, **options))
        return found[-1]

    yield make
    for each in found:
        each.close()


def test_what_two_cameras_saw_becomes_a_rig(made, tmp_path, tf2):
    desk = made(seen_rig('left', 'rear'))
    assert desk.step() == (WARN, 'collecting') and not desk.asked
    store(tmp_path, 'front', 0, 40)
    store(tmp_path, 'left', 0.3, 40.2)
    # another turn, and a straight piece
    store(tmp_path, 'rear', 90)
    store(tmp_path, 'rear', 40, prominence=0.001)
    assert desk.step() == (OK, 'placed')
    scenes, levels, base, since_s, speed, _ = desk.asked[0]
    assert {name: len(each) for name, each in scenes.items()} == {
        'front': 2, 'left': 2, 'rear': 1}
    assert (levels, base, since_s, speed) == (dict.fromkeys(NAMES, 'accepted'), 'front', 0.0, None)
    said, = desk.published
    assert said['base'] == 'front' and said['cameras']['left']['verdict'] == 'accepted'
    assert said['cameras']['left']['calibration'] == 'left/calibrator/calibration'
    assert load_rig(tmp_path).cameras['rear'].verdict == 'accepted'
    sent, = transforms(desk.endpoints)
    assert [(each.header.frame_id, each.child_frame_id) for each in sent] == [
        ('front_optical', 'left_optical'), ('front_optical', 'rear_optical')]
    # where it is, from the front camera's axes
    left = seen_rig('left', 'rear').cameras['left']
    at = sent[0].transform.translation
    np.testing.assert_allclose(left.rotation @ [at.x, at.y, at.z], -np.array(left.translation_m))
    # the same turns are not asked again
    assert desk.step() == (OK, 'placed') and len(desk.asked) == 1


@pytest.mark.parametrize('again', [False, True])
def test_a_camera_that_was_moved_is_named(made, tmp_path, again):
    desk = made(seen_rig('left', 'rear'), seen_rig('left', 'rear', turned='left', seed=1))
    for name in NAMES:
        store(tmp_path, name, 0, 40)
    assert desk.step() == (OK, 'placed')
    if again:
        # another drive, with what the stores have then
        desk.close()
        desk = made(seen_rig('left', 'rear', turned='left', seed=1))
        assert desk.step() == (ERROR, 'moved') and desk.asked[0][3] == 0.0
    else:
        for name in NAMES:
            store(tmp_path, name, 80)
        # one turn alone is confirmed by nothing
        assert desk.step() == (OK, 'placed') and len(desk.asked) == 1
        for name in NAMES:
            store(tmp_path, name, 120)
        assert desk.step() == (ERROR, 'moved')
        # later turns say where cameras sit, all what the lenses are
        assert desk.asked[1][3] == BEGIN_S + 40 and len(desk.asked[1][0]['left']) == 4
    moved = desk.placing._moved
    assert 'left' in moved and 'rear' not in moved and 'front' not in moved
    # where it sits now is published
    now = desk.published[-1]['cameras']['left']
    assert now['rotation_deg'] == pytest.approx(
        seen_rig('left', 'rear', turned='left', seed=1).cameras['left'].rotation_deg)
    # the others stay where they were found first
    assert desk.published[-1]['cameras']['rear'] == desk.published[0]['cameras']['rear'] or again
    assert (tmp_path / 'rig.json').exists()
    assert desk.placing._reset()[0] and desk.step() == (WARN, 'collecting')
    assert not (tmp_path / 'rig.json').exists()


def test_of_two_cameras_either_may_have_moved(made, tmp_path):
    desk = made(seen_rig('left'), seen_rig('left', turned='left', seed=1), names=NAMES[:2])
    for after in (0, 100):
        for name in NAMES[:2]:
            store(tmp_path, name, after, after + 40)
        found = desk.step()
    assert found == (ERROR, 'moved') and len(desk.published) == 2
    assert {name for name in NAMES if name in desk.placing._moved} == {'front', 'left'}


def test_what_is_not_moved_stays_as_it_is(made, tmp_path):
    first = seen_rig('left', 'rear')
    desk = made(first, seen_rig('left', 'rear', seed=1), seen_rig('left', 'rear', seed=2))
    for after in (0, 100, 200):
        for name in NAMES:
            store(tmp_path, name, after, after + 40)
        assert desk.step() == (OK, 'placed')
    assert len(desk.asked) == 3 and len(desk.published) == 1
    assert desk.asked[2][3] == BEGIN_S + 140


def test_a_camera_that_is_refused_keeps_no_other_one(made, tmp_path, tf2):
    nowhere = not_placed('', Notice('E-RIG-NO-SCENES', 'rear: nothing'))
    some = seen_rig('left')
    desk = made(replace(some, cameras={**some.cameras, 'rear': nowhere}),
                seen_rig('left', 'rear', seed=1))
    for name in NAMES[:2]:
        store(tmp_path, name, 0, 40)
    assert desk.step() == (WARN, 'collecting') and 'rear' in desk.placing._state()[2]
    assert [each.child_frame_id for each in transforms(desk.endpoints)[0]] == ['left_optical']
    for name in NAMES:
        store(tmp_path, name, 100, 140)
    assert desk.step() == (OK, 'placed')
    # what was known about the left one stays
    now = desk.published[-1]['cameras']
    assert now['left']['rotation_deg'] == desk.published[0]['cameras']['left']['rotation_deg']
    assert now['rear']['verdict'] == 'accepted'


def test_a_weak_rig_is_not_published(made, tmp_path):
    def weak(rig):
        return replace(rig, cameras={name: replace(
            camera, verdict='weak', reasons=(Notice('E-RIG-LENS', f'{name}: its lens is weak'),))
            for name, camera in rig.cameras.items()})

    desk = made(weak(seen_rig('left', 'rear')), seen_rig('left', 'rear'), lenses=NAMES[1:])
    for name in NAMES:
        store(tmp_path, name, 0, 40)
    # nothing can be accepted against a base that is not
    assert desk.step() == (WARN, 'collecting') and not desk.asked
    desk.lenses('front')
    assert desk.step() == (WARN, 'collecting') and len(desk.asked) == 1
    assert not desk.published and not (tmp_path / 'rig.json').exists()
    # the same turns, as soon as a calibrator has withdrawn its lens and accepted another one
    desk.endpoints.heard['rear/calibrator/calibration'](CameraInfo())
    assert desk.step() == (OK, 'placed') and len(desk.published) == 1
    assert desk.asked[1][1] == {'front': 'accepted', 'left': 'accepted', 'rear': 'weak'}


def test_turns_are_kept_when_calibrators_remove_them(made, tmp_path):
    desk = made(seen_rig('left', 'rear'))
    for file in store(tmp_path, 'front', 0):
        desk.step()
        file.unlink()
    # damaged, and of another size: another camera's
    (tmp_path / 'left').mkdir()
    (tmp_path / 'left' / 'turn-0123456789abcdef.npz').write_bytes(b'nothing')
    store(tmp_path, 'front', 40)
    store(tmp_path, 'left', 0, 40, 40.5, -5000)
    assert desk.step() == (OK, 'placed')
    assert [turn.stamp_s - BEGIN_S for turn in desk.placing.inputs.turns['left']] == [0, 40.5]
    assert desk.endpoints.complaints.counts['store'] == 1
    store(tmp_path, 'left', 80, frame_id='other_optical')
    desk.step()
    assert len(desk.placing.inputs.turns['left']) == 1


def test_frames_that_others_publish_and_rigs_without_metres_get_no_transform(
        made, tmp_path, tf2):
    rig = seen_rig('left', 'rear')
    desk = made(replace(rig, cameras={**rig.cameras, 'left': replace(
        rig.cameras['left'], translation_m=None, translation_sigma_m=None)}))
    step = desk.placing._step('car', 'rear_optical', rig.cameras['rear'])
    desk.endpoints.heard['/tf_static'](type('Message', (), {'transforms': [step]}))
    for name in NAMES:
        store(tmp_path, name, 0, 40)
    assert desk.step() == (OK, 'placed') and not transforms(desk.endpoints)
    assert sum('no static transform' in line for line in desk.endpoints.lines) == 2


@pytest.mark.parametrize(('names', 'code'), [
    ('', 'E-RIG-NODE-CAMERAS'), ('front', 'E-RIG-NODE-CAMERAS'),
    ('front front', 'E-RIG-NODE-CAMERAS'), ('front left front', 'E-RIG-NODE-CAMERAS'),
    ('front ../x', 'E-CAMERA-NAME')])
def test_names_that_are_no_cameras_are_refused(made, names, code):
    with pytest.raises(ConfigError) as raised:
        made(names=names.split(' '))
    assert raised.value.code == code


def test_a_file_of_other_cameras_is_left_alone(made, tmp_path):
    desk = made(seen_rig('left', 'rear'))
    for name in NAMES:
        store(tmp_path, name, 0, 40)
    desk.step()
    desk.close()
    for names in (('left', 'front', 'rear'), ('front', 'left')):
        assert made(names=names).placing.rig is None
    (tmp_path / 'rig.json').write_text('{}')
    assert made().placing.rig is None
    assert isinstance(desk.placing.rig, RigCalibration)


def test_the_node_solves_turns_in_a_child(start_node, make_bench, tmp_path):
    """What it publishes and offers is what its page says."""
    node = start_node(command=[*QUICK_COMMAND, 'rig'], cameras='front left', stores=tmp_path,
                      intrinsics__profile_tracks=40)
    bench, heard = make_bench(listen=False), {}
    for name, kind in (('/diagnostics', DiagnosticArray), ('rig/result', String)):
        bench.node.create_subscription(
            kind, name, lambda message, name=name: heard.update({name: message}),
            QoSProfile(depth=1) if kind is DiagnosticArray else QoSProfile(
                depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))

    def values():
        status, = heard['/diagnostics'].status
        return {pair.key: pair.value for pair in status.values}

    bench.until(lambda: '/diagnostics' in heard and values()['state'] == 'collecting', node=node)

    def full(name):
        return '/' + name.replace('~', 'rig').lstrip('/')

    def found(kind):
        with suppress(NodeNameNonExistentError):
            return set(dict(getattr(bench.node, f'get_{kind}_names_and_types_by_node')(
                'rig', '/')))
        return set()

    rest = {full(name) for name in OF_RCLPY['topics']}
    published = {full(name) for name, topic in PUBLISHED.items() if 'rig' in topic.programs}
    bench.until(lambda: found('publisher') - rest == published - {'/tf_static'}, node=node)
    assert found('subscriber') - rest == {
        '/front/calibrator/calibration', '/left/calibrator/calibration'}
    assert found('service') == {full(name) for name in OF_RCLPY['services']} | {
        full(each.name) for each in SERVICES if 'rig' in each.programs}
    assert [name for name, topic in SUBSCRIBED.items() if 'rig' in topic.programs] == [
        '/tf_static', 'NAME/calibrator/calibration', 'odom']
    for name in ('front', 'left'):
        store(tmp_path, name, 0, 40)
        bench.node.create_publisher(
            CameraInfo, f'{name}/calibrator/calibration', QoSProfile(
                depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)).publish(
                    CameraInfo(k=[400.0, *[0.0] * 8]))
    bench.until(lambda: 'rig/result' in heard, limit=120, node=node)
    left = json.loads(heard['rig/result'].data)['cameras']['left']
    # both saw the same
    assert np.abs(left['rotation_deg']).max() < 0.1 and left['translation_m'] is None
    bench.until(lambda: values()['state'] == 'placed', node=node)
    assert load_rig(tmp_path).base == 'front' and 'failed_calibrations' not in values()
    assert node.children() and node.stop() == 0
