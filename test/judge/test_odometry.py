# SPDX-License-Identifier: Apache-2.0
"""How far cameras are from true poses."""
from __future__ import annotations

import numpy as np
import pytest
from solving import CONFIG
from synthetic import LENS, rotation, synthetic_turn

from dashcalib_ros.errors import InputError
from dashcalib_ros.input.poses import Poses
from dashcalib_ros.judge.odometry import mounting, odometry, path_files

MOUNT = rotation(0, 0.3) @ rotation(2, -0.2)


@pytest.fixture(scope='module')
def motion():
    """Return two turns beside their truth, which is given in the frame of another sensor."""
    turns = [synthetic_turn(yaw_deg=yaw, keyframes=14, tracks=150, world=world)
             for world, yaw in enumerate((80.0, -70.0))]
    rotations = np.zeros((2000, 3, 3))
    rotations[:] = np.eye(3)
    positions = np.zeros((2000, 3))
    scenes = []
    for turn, center in zip(turns, (0, 1000), strict=True):
        structure = turn.structure
        frames = turn.tracks.frames + center
        turned = structure.rotations.transpose(0, 2, 1)
        positions[frames] = -np.einsum('kij,kj->ki', turned, structure.translations)
        rotations[frames] = turned @ MOUNT
        scene = turn.scene(LENS, center)
        object.__setattr__(scene.tracks, 'frames', frames)
        scenes.append(scene)
    cameras = {'given': LENS.with_focal(1.05 * LENS.fx), 'ours': LENS}
    return odometry(scenes, cameras, Poses(rotations, positions), CONFIG)


def test_the_camera_that_is_right_finds_the_rotation(motion):
    medians = motion.medians()
    assert len(motion.turns) == 2 and motion.turns[0].angle_deg == pytest.approx(80.0, abs=2.0)
    assert medians['rotation_deg']['ours'] < 0.1 < 1.0 < medians['rotation_deg']['given']
    assert medians['scale_drift']['ours'] < 0.01 < medians['scale_drift']['given']
    length = motion.turns[0].length_m
    assert length == pytest.approx(26.0, abs=1.0)
    assert medians['rotation_deg_per_100m']['given'] > 2 * medians['rotation_deg']['given']


def test_where_the_other_sensor_sits_is_found_from_the_turns(motion):
    # the axis that all turns share leaves one angle open: what is turned is what counts
    found = mounting(motion)
    for turn in motion.turns:
        seen = turn.paths['ours'].rotations
        own = found @ (seen[0].T @ seen[-1]) @ found.T
        true = turn.true.rotations[0].T @ turn.true.rotations[-1]
        np.testing.assert_allclose(own, true, atol=5e-3)


def test_the_paths_are_written_for_evo(motion):
    files = path_files(motion)
    assert set(files) == {f'turn_{center:06}_{name}.tum' for center in (0, 1000)
                          for name in ('poses', 'given', 'ours')}
    table = np.array([line.split() for line in files['turn_000000_ours.tum'].splitlines()], float)
    assert table.shape == (14, 8)
    np.testing.assert_allclose(table[:, 0], 0.3 * np.arange(14))
    np.testing.assert_allclose(np.linalg.norm(table[:, 4:], axis=1), 1.0, atol=1e-6)


def test_poses_of_another_time_are_refused(motion):
    scene = synthetic_turn(keyframes=8, tracks=100).scene(LENS)
    late = Poses(np.tile(np.eye(3), (3, 1, 1)), np.zeros((3, 3)), 1e9 + np.arange(3.0))
    with pytest.raises(InputError) as caught:
        odometry([scene], {'ours': LENS}, late, CONFIG)
    assert caught.value.code == 'E-NO-POSES-OF-TURNS'
