# SPDX-License-Identifier: Apache-2.0
"""Pictures of two cameras of one car, ahead and back, with exact truth: from drives to a rig."""
from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from made_rig import Mounted, made_paths
from refused import refused
from shared_drive import LENS, QUICK, SPEC
from solving import remembered

from dashcalib_ros import rig_session
from dashcalib_ros.camera import Radial
from dashcalib_ros.camera.rotation import rotation_matrices, rotation_vectors
from dashcalib_ros.cli import demo
from dashcalib_ros.cli.program import main
from dashcalib_ros.cli.rig import write_rig
from dashcalib_ros.demo import Drive, Mounting, render_to_bag, true_places
from dashcalib_ros.errors import InputError, Notice
from dashcalib_ros.formats import load_camera
from dashcalib_ros.formats.rig import RIG_FORMATS, load_rig
from dashcalib_ros.input.motion import Samples, SensorStream
from dashcalib_ros.judge import Verdict
from dashcalib_ros.rig import live
from dashcalib_ros.rig.joint import solved
from dashcalib_ros.rig.live import rig_of_scenes
from dashcalib_ros.rig.start import aligned, problem_of

BACK = replace(SPEC, rolling_shutter_ms=12.0, mounting=Mounting(
    178.0, -3.0, 1.0, -0.9, -0.1, 1.2, phase_s=0.05, late_s=0.3))


@pytest.fixture(scope='module')
def placed(shared_drive, tmp_path_factory):
    """The rig, and what it was made of: drives, and what went into each camera's path."""
    folder, kept = tmp_path_factory.mktemp('rig'), {}
    drives = {'front': shared_drive, 'rear': Drive(LENS, BACK)}
    for name, drive in drives.items():
        render_to_bag(drive, folder / name)
    ride = shared_drive.ride
    times = np.arange(0.0, ride.duration - 0.2, 0.05)
    speed = np.gradient(np.interp(times + 0.1, ride.t, ride.s), times)

    def keeping(*given):
        kept[given[0]] = given
        return before(*given)

    before = rig_session.camera_paths
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rig_session, 'camera_paths', keeping)
        found = rig_session.calibrate_rig(
            {name: folder / name for name in drives}, config=QUICK,
            motion=SensorStream(speed=Samples(times, speed[:, None])))
    return found, drives, kept


@pytest.mark.parametrize(('names', 'base'), [(['front'], None), (['front', 'rear'], 'left')])
def test_a_rig_needs_two_cameras_and_its_base(names, base):
    with refused(InputError, 'E-RIG-CAMERAS', base):
        rig_session.rig_of_drives(dict.fromkeys(names), base)


def test_a_known_height_above_the_road_gives_metres_without_a_speed(placed, monkeypatch):
    found, drives, kept = placed
    ride = drives['front'].ride
    front = rig_session.Learned(None, found.calibrations['front'], kept['front'][1], None, None)

    def in_its_unit(scene, down):
        """Return what a road with more points than these few tracks would show."""
        assert down == pytest.approx([0, 1, 0], abs=0.03)
        seconds = scene.tracks.stamps_ns[scene.structure.registered] / 1e9 - front.start_s
        length = np.linalg.norm(np.diff(scene.structure.path()[1], axis=0), axis=1).sum()
        return np.log(1.4 * length / np.ptp(np.interp(seconds, ride.t, ride.s))), 0.001

    monkeypatch.setattr(rig_session, 'log_height', in_its_unit)
    known = QUICK.replace({'known.height': '1.4±0.028'})
    metres = rig_session._by_height(front, known, 0.0)
    assert metres.sigma == pytest.approx(np.hypot(0.02, 0.01), rel=0.01)
    times = np.arange(0.0, ride.duration - 0.2, 0.05)
    true, seen = np.gradient(np.interp(times, ride.t, ride.s), times), metres.speed(times)
    inside = (seen > 0) & (true > 1)
    assert inside.sum() > 100
    assert np.median(seen[inside] / true[inside]) == pytest.approx(1.0, abs=0.03)
    # between the stretches nothing is known; nor where a camera is not aligned, or no height is
    assert (seen == 0).sum() > 20
    assert rig_session._by_height(front, known, None) is None
    assert rig_session._by_height(front, QUICK, 0.0) is None


def test_pictures_show_where_a_camera_sits(placed):
    found, drives, _ = placed
    true, rear = true_places(drives, 'front')['rear'], found.rig.cameras['rear']
    off = np.degrees(rotation_vectors((rear.rotation @ true.rotation.T)[None])[0])
    assert np.all(np.abs(off) < 3.5 * np.array(rear.rotation_sigma_deg))
    assert max(rear.rotation_sigma_deg) < 0.3 and rear.visible.rotation == ('accepted',) * 3
    assert abs(rear.time_offset_s - true.time_offset_s) < 3.5 * rear.time_sigma_s < 0.01
    away = np.array(rear.translation_m) - true.translation_m
    assert np.all(np.abs(away) < 3.5 * np.array(rear.translation_sigma_m))
    assert found.rig.accepted and not found.rig.witness
    assert [each.mount.rear for each in found.calibrations.values()] == [False, True]


def test_a_lens_and_its_verdict_stay_together(placed):
    found, _, kept = placed
    for name, (_, solution, *_) in kept.items():
        # what was judged is what is written, whatever the other cameras ask for
        written = found.calibrations[name]
        assert written.camera == solution.camera and written.verdict.level == 'accepted'
        np.testing.assert_allclose(list(written.sigma.values()), solution.sigma)


def test_every_image_is_posed_as_its_shutter_saw_it(placed):
    _, drives, kept = placed
    drive = drives['rear']
    stamps = [drive.stamp_ns(index) for index in range(len(drive))]
    stretches = kept['rear'][2]
    assert len(stretches) == 2
    for each in stretches:
        structure, rows = each.scene.structure, each.scene.observed.keyframes
        true = np.array([drive.row_poses(stamps.index(stamp))[0][LENS.size[1] // 2].T
                         for stamp in each.scene.tracks.stamps_ns[rows]])
        found, truth = (every[1:] @ every[:-1].transpose(0, 2, 1)
                        for every in (structure.rotations[rows], true))
        off = np.degrees(rotation_vectors(found @ truth.transpose(0, 2, 1)))
        # bumps pitch the car while rows are exposed, at rates that no two poses tell
        assert len(rows) > 25 and np.sqrt(np.mean(off**2, axis=0)).max() < 0.007


def test_turns_without_their_images_show_it_too(placed, monkeypatch):
    """As a live drive has them: less is known, and the sigmas say so."""
    monkeypatch.setattr(live, '_solved', remembered(live._solved))
    _, drives, kept = placed
    scenes = {name: solution.scenes for name, (_, solution, *_) in kept.items()}
    rig = rig_of_scenes(scenes, dict.fromkeys(scenes, 'accepted'), 'front', 0.0, None, QUICK)
    true, rear = true_places(drives, 'front')['rear'], rig.cameras['rear']
    off = np.degrees(rotation_vectors((rear.rotation @ true.rotation.T)[None])[0])
    assert np.all(np.abs(off) < 3.5 * np.array(rear.rotation_sigma_deg))
    assert max(rear.rotation_sigma_deg) < 0.3 and rear.verdict == 'accepted'
    assert abs(rear.time_offset_s - true.time_offset_s) < 3.5 * rear.time_sigma_s < 0.01
    # with the turns of later than both, nothing shows where it sits
    later = max(int(scene.tracks.stamps_ns[-1]) for scene in scenes['front']) / 1e9
    rig = rig_of_scenes(scenes, dict.fromkeys(scenes, 'accepted'), 'front', later, None, QUICK)
    assert [each.code for each in rig.cameras['rear'].reasons] == ['E-RIG-NO-SCENES']
    # of one camera alone
    rig = rig_of_scenes({**scenes, 'rear': ()}, dict.fromkeys(scenes, 'weak'), 'front', 0.0, None,
                        QUICK)
    assert rig.cameras['rear'].verdict == 'refused' and rig.cameras['front'].verdict == 'weak'


@pytest.mark.parametrize('off_deg', [0.0, 2.0])
def test_matches_are_used_unless_they_contradict_a_place(monkeypatch, off_deg):
    """off_deg: by which the second camera is turned more in the matches."""
    turn = rotation_matrices(np.radians([[0.5, -2.0, 1.0]]))[0]
    paths, _ = made_paths({'front': Mounted(), 'right': Mounted((0.5, -2.0, 1.0),
                                                                (-0.5, 0.02, 0.03))},
                          lens_sigma=0.01)
    best = solved(problem_of(paths, 'front', {'right': aligned(paths['right'], paths['front'])},
                             None))
    camera = Radial((800, 450), 520.0, 520.0, 400.0, 225.0, -0.2, 0.05)
    rng = np.random.default_rng(0)
    depth = rng.uniform(6, 40, 900)
    points = depth[:, None] * np.column_stack([
        rng.uniform(-0.6, 0.6, 900), rng.uniform(-0.35, 0.35, 900), np.ones(900)])
    more = rotation_matrices(np.radians([[off_deg, 0.0, 0.0]]))[0]
    pairs = tuple(camera.project(each) + 0.2 * rng.normal(size=(900, 2)) for each in (
        points, (points @ turn.T + [-0.5, 0.02, 0.03]) @ more.T))
    inside = np.isfinite(pairs[0] + pairs[1]).all(axis=1)
    one = SimpleNamespace(solution=SimpleNamespace(camera=camera, field=None),
                          scale=SimpleNamespace(px=2.0))
    real = rig_session.rotation_by_matches

    def by_matches(pair, cameras, matches, fields, across, sigmas):
        # the lenses of made paths are no cameras
        found = real(pair, cameras, matches, fields, across, [np.full(20, 1e-3)] * 2)
        return replace(found, follow={name: np.zeros((3, len(each)))
                                      for name, each in zip(pair, sigmas, strict=True)})

    monkeypatch.setattr(rig_session, 'rotation_by_matches', by_matches)
    for use in (False, True):
        found = rig_session._witnessed(dict.fromkeys(paths, one), best, {('front', 'right'): [
            tuple(side[inside] for side in pairs)]}, use)
        if off_deg:
            assert [each.code for each in found.doubts['right']] == ['E-RIG-EPIPOLAR']
            assert not found.matched
        else:
            assert not found.doubts and len(found.matched) == use
            # in px of the input
            assert found.epipolar['front', 'right'].median < 0.6


def test_a_rig_is_written_for_all_who_take_it(placed, tmp_path):
    found, _, _ = placed
    write_rig(found, tmp_path)
    assert {each.name for each in tmp_path.iterdir()} == {
        'rig.json', 'report.html', 'front', 'rear', *RIG_FORMATS}
    read = load_rig(tmp_path)
    assert read == found.rig and read.accepted
    for name, camera in read.cameras.items():
        given = load_camera(tmp_path / camera.calibration)
        assert given.camera == found.calibrations[name].camera and given.verdict == 'accepted'
    # written again, without what it cannot have any more
    refused = {name: replace(each, camera=None, sigma=None, covariance=None, sigma_px=None,
                             verdict=Verdict('refused', (Notice('E-NO-TURNS', 'no turns'),)))
               for name, each in found.calibrations.items()}
    write_rig(replace(found, calibrations=refused), tmp_path)
    assert not (tmp_path / 'camchain.yaml').exists() and (tmp_path / 'rig.urdf').exists()


@pytest.mark.thorough
def test_the_demo_renders_a_rig_and_tells_the_truth(shared_drive, tmp_path, monkeypatch, capfd):
    drives = {'front': shared_drive, 'rear': Drive(LENS, BACK)}
    monkeypatch.setattr(demo, 'rig_drives', lambda seed: drives)
    monkeypatch.setattr(demo, 'read_config', lambda args: QUICK)
    folder = tmp_path / 'demo'
    code = main(['demo', '--rig', '--json', '--keep-bag', '--out', str(folder)])
    truth = json.loads((folder / 'truth.json').read_text())
    found = load_rig(folder)
    assert code == 0 and found.accepted and json.loads(capfd.readouterr().out)['base'] == 'front'
    assert {'bag-front', 'bag-rear', 'front', 'rear', *RIG_FORMATS} < {
        each.name for each in folder.iterdir()}
    true, rear = truth['cameras']['rear'], found.cameras['rear']
    turn = rotation_matrices(np.radians([true['rotation_deg']]))[0]
    off = np.degrees(rotation_vectors((rear.rotation @ turn.T)[None])[0])
    assert truth['base'] == 'front' and np.all(np.abs(off) < 3.5 * np.array(
        rear.rotation_sigma_deg))
    assert abs(rear.time_offset_s - true['time_offset_s']) < 3.5 * rear.time_sigma_s
    # no speed, no metres
    assert rear.translation_m is None
