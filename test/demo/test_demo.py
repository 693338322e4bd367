# SPDX-License-Identifier: Apache-2.0
"""The rendered drives are exact: every other test that uses them relies on this one."""
from __future__ import annotations

import dataclasses
import os
from functools import partial

import cv2
import numpy as np
import pytest
from refused import refused

from dashcalib_ros.camera import calibrated_models
from dashcalib_ros.demo import (
    DEMOS,
    Drive,
    DriveSpec,
    FisheyeLens,
    Glass,
    Lens,
    Stop,
    Turn,
    demo_drive,
)
from dashcalib_ros.demo.atlas import MAX_SIDE, pack
from dashcalib_ros.demo.fisheye import WholeRaycaster
from dashcalib_ros.demo.parallel import render_parallel
from dashcalib_ros.demo.quads import Quads
from dashcalib_ros.demo.raycast import Raycaster
from dashcalib_ros.demo.rig import RIGS, rig_drives
from dashcalib_ros.errors import ConfigError, WorkerError

LENS = Lens.of(640, 360, 75.0, -0.30, 0.10, offset=(9.0, -6.0), aspect=1.003)
SPEC = DriveSpec(turns=(Turn(80.0, 10.0),), seed=3, noise=0.0, flicker=0.0, bonnet=True)
DOT = 96


@pytest.fixture(scope='module')
def drive() -> Drive:
    return Drive(LENS, SPEC)


def variant(drive: Drive, **changes) -> Drive:
    """Return the drive with a changed spec but the same town, which takes long to build."""
    other = Drive(drive.lens, dataclasses.replace(drive.spec, **changes))
    other.__dict__['town'] = drive.town
    other.__dict__['raycaster'] = drive.raycaster
    return other


# -- the lens ---------------------------------------------------------------------------------

def test_lens_inverts_exactly():
    pixels = np.random.default_rng(0).uniform((-0.5, -0.5), (639.5, 359.5), (500, 2))
    rays = np.column_stack([LENS.undistort(pixels), np.ones(500)])
    opencv, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), LENS.matrix, LENS.distortion)
    assert np.abs(opencv[:, 0] - pixels).max() < 1e-8
    assert np.abs(LENS.project(rays) - pixels).max() < 1e-8


def test_lens_that_folds_is_refused():
    with refused(ConfigError, 'E-LENS-FOLDS'):
        Lens.of(640, 360, 110.0, -0.45, 0.0)
    Lens.of(1392, 512, 80.0, -0.363, 0.151)


@pytest.mark.parametrize('wrong', [{'width': 15}, {'height': 0}, {'fx': 0.0}, {'fy': -1.0}])
def test_a_lens_without_a_picture_is_refused(wrong):
    with refused(ConfigError, 'E-LENS-RANGE'):
        dataclasses.replace(LENS, **wrong)


# -- geometry ---------------------------------------------------------------------------------

def dots_in_front(drive: Drive, frame: int) -> tuple[Quads, np.ndarray, list]:
    """Return three walls with a bright dot in the middle of each cell, and the dots (n, 3)."""
    texture = np.full((DOT, DOT), 20.0)
    grid = np.arange(DOT) - (DOT - 1) / 2.0
    texture += 200.0 * np.exp(-(grid[:, None] ** 2 + grid ** 2) / (2.0 * 11.0 ** 2))
    pose = drive.poses[frame]
    quads, points = [], []
    for depth, size in ((5.0, 0.35), (9.0, 0.6)):
        for x in np.linspace(-0.85, 0.85, 8):
            for y in np.linspace(-0.42, 0.42, 5):
                x_shift = x + (0.06 if depth == 5.0 else -0.05)
                middle = pose[:3, :3] @ (x_shift * depth, y * depth, depth) + pose[:3, 3]
                right = pose[:3, 0] * size
                down = pose[:3, 1] * size
                # lean the wall, so that its perspective counts
                right = right + pose[:3, 2] * 0.3 * size
                quads.append((middle - 0.5 * right - 0.5 * down, right, down))
                points.append(middle)
    origin, right, down = (np.array([quad[i] for quad in quads]) for i in range(3))
    wall = Quads(origin, right, down, np.zeros(len(quads), np.int64))
    return wall, np.array(points), [texture.astype(np.uint8)]


def centroid(image: np.ndarray, near: np.ndarray, radius: int = 6) -> np.ndarray | None:
    """Return the bright dot's centre near a pixel, or None at the border."""
    for _ in range(6):
        x, y = np.round(near).astype(int)
        if not (radius <= x < image.shape[1] - radius and radius <= y < image.shape[0] - radius):
            return None
        part = image[y - radius:y + radius + 1, x - radius:x + radius + 1].astype(float)
        grid = np.arange(-radius, radius + 1)
        weight = np.maximum(part - 70.0, 0.0) * np.exp(
            -((grid[:, None] + y - near[1]) ** 2 + (grid + x - near[0]) ** 2) / 18.0)
        if weight.sum() <= 0.0:
            return None
        near = np.array([x + (weight.sum(0) * grid).sum() / weight.sum(),
                         y + (weight.sum(1) * grid).sum() / weight.sum()])
    return near


@pytest.mark.parametrize('shutter', [0.0, 30.0])
def test_world_points_appear_where_opencv_projects_them(drive, shutter):
    drive = variant(drive, rolling_shutter_ms=shutter)
    frame = drive.turn_centers[0]
    quads, points, textures = dots_in_front(drive, frame)
    rotations, positions = drive.row_poses(frame)
    image = Raycaster(LENS, pack(textures)).render(quads, rotations, positions)
    errors, shifts = [], []
    for point in points:
        row = LENS.height / 2.0
        for _ in range(10):
            k = min(max(round(row), 0), len(rotations) - 1)
            world_to_camera = rotations[k].T
            rotation = cv2.Rodrigues(world_to_camera)[0]
            pixel = cv2.projectPoints(point[None], rotation, -world_to_camera @ positions[k],
                                      LENS.matrix, LENS.distortion)[0][0, 0]
            row = pixel[1]
        found = centroid(image, pixel)
        if found is not None:
            errors.append(found - pixel)
            k = len(rotations) // 2
            middle = LENS.project((point - positions[k]) @ rotations[k])[0]
            shifts.append(np.linalg.norm(middle - pixel))
    errors = np.array(errors)
    assert len(errors) > 25
    assert np.linalg.norm(np.median(errors, axis=0)) < 0.02
    assert np.percentile(np.linalg.norm(errors, axis=1), 90) < 0.1
    # each row really has its own pose: this point would be elsewhere with the middle row's
    assert (max(shifts) > 3.0) == (shutter > 0.0)


@pytest.mark.parametrize('gap', [1, 3])
def test_tracks_of_a_turn_fit_the_true_motion(drive, gap):
    drive = variant(drive, noise=1.5)
    first = drive.turn_centers[0]
    images = [drive.frame(index).image for index in (first, first + gap)]
    below = np.where(drive.overlay.mask, 0, 255).astype(np.uint8)
    start = cv2.goodFeaturesToTrack(images[0], 800, 0.005, 6, mask=cv2.erode(below, None,
                                                                           iterations=12))
    window = dict(winSize=(15, 15), maxLevel=4)
    there, found, _ = cv2.calcOpticalFlowPyrLK(images[0], images[1], start, None, **window)
    back, _, _ = cv2.calcOpticalFlowPyrLK(images[1], images[0], there, None, **window)
    good = (found[:, 0] > 0) & (np.linalg.norm((back - start)[:, 0], axis=1) < 0.3)
    assert good.sum() > 150
    a, b = (np.column_stack([LENS.undistort(points[good, 0]), np.ones(good.sum())])
            for points in (start, there))
    relative = np.linalg.inv(drive.poses[first + gap]) @ drive.poses[first]
    t = relative[:3, 3]
    essential = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]]) @ relative[:3, :3]
    forward, backward = a @ essential.T, b @ essential
    slope = np.sum(forward[:, :2] ** 2, axis=1) + np.sum(backward[:, :2] ** 2, axis=1)
    error = np.sum(b * forward, axis=1) / np.sqrt(slope)
    assert np.median(np.abs(error)) * LENS.fx < 0.15
    # ... and they do not drift to one side
    assert abs(np.median(error)) * LENS.fx < 0.03


def test_poses_follow_a_car(drive):
    """The rear axle moves along the car's heading; the camera in front of it swings out."""
    ride = drive.ride
    moving = np.column_stack([np.gradient(ride.x), np.gradient(ride.y)])
    sideways = moving[:, 1] * np.cos(ride.yaw) - moving[:, 0] * np.sin(ride.yaw)
    assert np.abs(sideways).max() < 1e-3 * np.abs(moving).max()
    center = drive.turn_centers[0]
    step = drive.poses[center + 1, :3, 3] - drive.poses[center - 1, :3, 3]
    direction = np.arctan2(step[1], step[0])
    assert 0.05 < direction - drive.yaw[center] < 0.3
    heights = drive.poses[:, 2, 3]
    assert 1.25 < heights.min() < heights.max() < 1.55
    pitch = np.degrees(np.arcsin(drive.poses[:, 2, 2]))
    assert 0.2 < pitch.std() < 1.5
    level = dataclasses.replace(drive.spec, vibration_deg=0.0)
    assert np.ptp(Drive(LENS, level).poses[:, 2, 3]) < 1e-9


def test_truth_of_turns():
    drive = Drive(LENS, DriveSpec(turns=4, seed=5))
    assert len(drive.turn_centers) == 4
    for turn, center in zip(drive.spec.turn_list, drive.turn_centers, strict=True):
        whole = np.degrees(drive.yaw[center + 30] - drive.yaw[center - 30])
        assert whole == pytest.approx(turn.angle_deg, abs=0.1)
        half = np.degrees(drive.yaw[center] - drive.yaw[center - 30])
        assert half == pytest.approx(turn.angle_deg / 2.0, abs=3.0)
    assert drive.truth == LENS.truth


def test_standard_demo():
    drive = demo_drive()
    assert drive.lens.width == 960 and len(drive.turn_centers) == 5
    assert 300 <= len(drive) <= 450
    assert drive.turn_centers[0] > 30 and drive.turn_centers[-1] + 30 < len(drive)
    assert drive.stamp_ns(10) - drive.stamp_ns(0) == 10**9


def test_each_demo_has_what_it_says():
    drives = {name: demo_drive(0, name) for name in DEMOS}
    names = {model.model: model.names() for model in calibrated_models()}
    for name, drive in drives.items():
        assert drive.lens.size == (960, 540)
        assert tuple(drive.truth) == names[drive.lens.model]
        assert drive.lens.model == (name if name in names else 'radial')
    assert drives['windscreen'].lens.glass is not None
    assert drives['shutter'].spec.rolling_shutter_ms == 25.0
    assert np.abs(drives['stabilised'].crop_px).max() == pytest.approx(48.0)
    assert np.ptp(drives['straight'].yaw) < 1e-9
    with pytest.raises(ConfigError) as error:
        demo_drive(0, 'mirror')
    assert error.value.code == 'E-DEMO-UNKNOWN'


# -- pictures ---------------------------------------------------------------------------------

def test_frames_are_reproducible(drive):
    noisy = variant(drive, noise=2.0)
    listed = list(noisy.frames(40, 43))
    assert [frame.index for frame in listed] == [40, 41, 42]
    alone = noisy.frame(42)
    assert alone.image.dtype == np.uint8 and alone.size == (640, 360)
    assert np.array_equal(alone.image, listed[2].image)
    assert alone.stamp_ns == listed[2].stamp_ns > listed[1].stamp_ns
    assert not np.array_equal(listed[0].image, listed[1].image)
    with pytest.raises(IndexError):
        noisy.frame(len(noisy))


@pytest.mark.thorough
def test_processes_and_seeds():
    lens = Lens.of(160, 90, 75.0, -0.1)
    spec = DriveSpec(turns=0, duration_s=1.0, lead_m=10.0, seed=1)
    one = [frame.image for frame in Drive(lens, spec).frames(0, 6)]
    two = [frame.image for frame in Drive(lens, spec).frames(0, 6, processes=2)]
    assert np.array_equal(one, two)
    other = Drive(lens, dataclasses.replace(spec, seed=2)).frame(0)
    assert not np.array_equal(one[0], other.image)


def test_ego_vehicle_stays(drive):
    hidden = drive.overlay.alpha == 1.0
    first, second = drive.frame(30).image, drive.frame(36).image
    assert np.array_equal(first[hidden], second[hidden])
    assert 0.04 < hidden.mean() < 0.12 and hidden[-1].all()
    outside = ~drive.overlay.mask
    assert np.mean(first[outside] != second[outside]) > 0.5
    pillar = variant(drive, pillar=True)
    del pillar.__dict__['raycaster']
    assert pillar.overlay.mask[100, 0] and not pillar.overlay.mask[100, 300]


def test_time_stamp_changes_each_second(drive):
    drive = variant(drive, timestamp=True)
    plain = np.full((360, 640), 100.0, np.float32)
    burnt = []
    for index in (0, 5, 10):
        image = plain.copy()
        drive.overlay.apply(image, drive.stamp_ns(index))
        burnt.append(image)
    assert np.array_equal(burnt[0], burnt[1]) and not np.array_equal(burnt[0], burnt[2])


# -- drives that must be refused ---------------------------------------------------------------

def test_parked_car_sees_a_still_world_and_moving_cars(drive):
    parked = variant(drive, kind='parked', duration_s=9.0)
    assert np.ptp(parked.poses, axis=0).max() == 0.0 and parked.turn_centers == ()
    assert np.array_equal(parked.frame(0).image, parked.frame(20).image)
    busy = variant(drive, kind='parked', duration_s=9.0, moving_cars=3)
    changed = [np.mean(busy.frame(i).image != busy.frame(i + 2).image) for i in range(0, 80, 20)]
    assert 0.0005 < max(changed) < 0.5


def test_car_that_spins_does_not_move(drive):
    spin = variant(drive, kind='spin', duration_s=8.0, vibration_deg=0.0)
    assert np.ptp(spin.poses[:, :3, 3], axis=0).max() < 1e-9
    assert np.ptp(spin.yaw) > 2.0


def test_straight_and_stops():
    straight = Drive(LENS, DriveSpec(turns=0, duration_s=20.0))
    assert np.ptp(straight.yaw) < 1e-9 and straight.turn_centers == ()
    stopping = Drive(LENS, DriveSpec(turns=1, stops=(Stop(0, 6.0),)))
    going = Drive(LENS, DriveSpec(turns=1))
    step = np.abs(np.diff(stopping.poses, axis=0)).max(axis=(1, 2))
    # the body still rocks a little just after it stopped
    assert 30 <= np.sum(step < 1e-9) <= np.sum(step < 1e-3) <= 62
    assert len(stopping) > len(going) + 60


def test_night_is_dark(drive):
    image = variant(drive, night=True).frame(drive.turn_centers[0]).image
    assert image.mean() < 30 and image.std() < 15


def test_exposure_blurs_around_the_same_place(drive):
    index = drive.turn_centers[0]
    sharp = drive.frame(index).image[:300]
    blurred = variant(drive, exposure_ms=20.0).frame(index).image[:300]
    assert cv2.Laplacian(blurred, cv2.CV_64F).std() < 0.8 * cv2.Laplacian(sharp, cv2.CV_64F).std()
    smooth = [cv2.GaussianBlur(image, (0, 0), 4.0).astype(float) for image in (sharp, blurred)]
    (dx, dy), _ = cv2.phaseCorrelate(*smooth)
    assert np.hypot(dx, dy) < 0.1


def test_corners_are_darker(drive):
    plain, dark = (variant(drive, vignetting=share).frame(10).image.astype(float)
                   for share in (0.0, 0.4))
    assert dark[:20, :20].mean() < 0.7 * plain[:20, :20].mean()
    assert abs(dark[170:190, 310:330].mean() / plain[170:190, 310:330].mean() - 1.0) < 0.01


def test_compression_loses_little(drive):
    plain = drive.frame(10).image.astype(float)
    packed = variant(drive, jpeg_quality=80).frame(10).image.astype(float)
    assert 0.1 < np.abs(plain - packed).mean() < 4.0


@pytest.mark.parametrize('wrong', [
    {'rate': 0.0}, {'noise': -1.0}, {'exposure_ms': 300.0}, {'vignetting': 2.0},
    {'turns': (Turn(200.0),)}, {'stops': (Stop(7, 1.0),)}, {'stabilised': 0.3}])
def test_impossible_drives_are_refused(wrong):
    with refused(ConfigError, 'E-DRIVE-RANGE'):
        DriveSpec(**wrong)


def test_what_cannot_be_rendered_is_refused():
    with refused(ConfigError, 'E-DEMO-TOO-LONG'):
        pack([np.zeros((2, MAX_SIDE), np.uint8)])
    with refused(ConfigError, 'E-LENS-TOO-WIDE'):
        WholeRaycaster(FisheyeLens.of(640, 360, 220.0), pack([np.zeros((8, 8), np.uint8)]))
    with refused(ConfigError, 'E-DEMO-RIG-UNKNOWN', "'bus'", *RIGS):
        rig_drives('bus')


def test_a_process_that_dies_ends_the_rendering():
    with refused(WorkerError, 'E-RENDERER-DIED'):
        list(render_parallel(partial(os._exit, 1), 0, 1, 1))


def test_a_lens_with_all_coefficients_is_opencvs_plumb_bob():
    lens = dataclasses.replace(LENS, p1=0.0016, p2=-0.0011, k3=-0.02)
    points = np.random.default_rng(0).uniform((-0.6, -0.3, 1.0), (0.6, 0.3, 1.0), (200, 3))
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), lens.matrix, lens.distortion)[0]
    np.testing.assert_allclose(lens.project(points), expected[:, 0], atol=1e-9)
    np.testing.assert_allclose(lens.undistort(lens.project(points)), points[:, :2], atol=1e-9)


@pytest.mark.parametrize('look', ['windscreen', 'rectified'])
def test_glass_moves_the_picture_by_what_it_says_and_no_lens_does_that(look):
    lens = dataclasses.replace(LENS, glass=Glass(2.0, look, seed=5))
    x, y = np.meshgrid(np.linspace(0.0, 639.0, 41), np.linspace(0.0, 359.0, 25))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    moved = lens.glass.displacement(pixels, lens.size)
    assert np.sqrt(np.mean(np.sum(moved**2, axis=1))) == pytest.approx(2.0, rel=0.05)
    rays = np.column_stack([lens.undistort(pixels), np.ones(len(pixels))])
    np.testing.assert_allclose(lens.project(rays), pixels, atol=1e-6)
    plain = dataclasses.replace(lens, glass=None)
    np.testing.assert_allclose(plain.project(rays), pixels - moved, atol=1e-6)


# -- fisheyes and stabilisers ------------------------------------------------------------------

FISHEYE = FisheyeLens.of(640, 360, 150.0, (-0.02, 0.006, -0.003, 0.0005), (9.0, -7.0), 1.002)


def test_a_fisheye_is_opencvs_and_inverts_exactly():
    pixels = np.random.default_rng(0).uniform((-0.5, -0.5), (639.5, 359.5), (500, 2))
    rays = FISHEYE.rays(pixels)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0)
    np.testing.assert_allclose(FISHEYE.project(rays), pixels, atol=1e-6)
    ahead = rays[rays[:, 2] > 0.1]
    matrix = np.array([[FISHEYE.fx, 0.0, FISHEYE.cx], [0.0, FISHEYE.fy, FISHEYE.cy], [0, 0, 1.0]])
    expected, _ = cv2.fisheye.projectPoints(ahead[:, None], np.zeros(3), np.zeros(3), matrix,
                                            np.array(FISHEYE.k))
    np.testing.assert_allclose(FISHEYE.project(ahead), expected[:, 0], atol=1e-8)
    with refused(ConfigError, 'E-LENS-FOLDS'):
        FisheyeLens.of(640, 360, 150.0, (-0.2, 0.0, 0.0, 0.0))


def test_a_fisheye_shows_world_points_where_it_projects_them(drive):
    wide = Drive(FISHEYE, drive.spec)
    wide.__dict__['town'] = drive.town
    frame = drive.turn_centers[0]
    quads, points, textures = dots_in_front(drive, frame)
    rotations, positions = wide.row_poses(frame)
    image = WholeRaycaster(FISHEYE, pack(textures)).render(quads, rotations, positions)
    # those of the near wall: it hides some of the far one; the outermost dots touch each other
    pixels = FISHEYE.project((points[:40] - positions[0]) @ rotations[0])
    found = [(pixel, centroid(image, pixel, 4)) for pixel in pixels]
    errors = np.array([seen - pixel for pixel, seen in found if seen is not None])
    assert len(errors) > 25
    assert np.linalg.norm(np.median(errors, axis=0)) < 0.02
    assert np.percentile(np.linalg.norm(errors, axis=1), 80) < 0.1


def test_a_stabiliser_moves_its_crop_against_the_turn():
    lens = Lens.of(320, 180, 75.0, -0.1)
    spec = DriveSpec(turns=(Turn(80.0),), seed=3, noise=0.0, flicker=0.0, vibration_deg=0.0)
    plain, steady = Drive(lens, spec), Drive(lens, dataclasses.replace(spec, stabilised=0.05))
    steady.__dict__['town'] = plain.town
    index = int(np.argmax(steady.crop_px))
    assert steady.crop_px[index] == pytest.approx(16.0) and steady.crop_px.min() > -0.1
    for frame, expected in ((index, steady.crop_px[index]), (3, 0.0)):
        one, other = (each.frame(frame).image.astype(float) for each in (plain, steady))
        (moved, down), _ = cv2.phaseCorrelate(one, other, cv2.createHanningWindow((320, 180),
                                                                                cv2.CV_64F))
        assert (moved, down) == pytest.approx((-expected, 0.0), abs=0.3)
