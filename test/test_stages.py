# SPDX-License-Identifier: Apache-2.0
"""The stages as functions, and what it takes to add a camera model."""
from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import cv2
import numpy as np
import pytest
import shared_drive as shared
from shared_drive import QUICK

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import (
    MODELS,
    PINHOLE,
    Camera,
    Radial,
    camera_from_ros,
    ros_camera,
)
from dashcalib_ros.camera.camera import ColmapModel
from dashcalib_ros.demo import Lens
from dashcalib_ros.detect.detection import Detection, detect
from dashcalib_ros.errors import ConfigError
from dashcalib_ros.formats import calibration_yaml, load_camera, result_dict
from dashcalib_ros.judge.conclude import conclude, evidence_of_detection
from dashcalib_ros.reconstruct import reconstruct
from dashcalib_ros.solve import solve

# one term is all that this lens has
LENS = Lens.of(640, 360, 70.0, -0.18, 0.0, offset=(5.0, -3.0))


@dataclass(frozen=True)
class OneTerm(Camera):
    """A model that only this test has: the paper's without k2."""

    k1: float = 0.0

    model: ClassVar[str] = 'one_term'
    ros_model: ClassVar[str] = 'plumb_bob'
    family: ClassVar[str] = PINHOLE
    colmap: ClassVar[ColmapModel] = ColmapModel('OPENCV', 8, (0, 1, 2, 3, 4))
    spread: ClassVar[tuple[float, ...]] = (1.0,)

    def widened(self) -> Camera:
        return Radial.of(self.image_size, [*self.params, 0.0])

    def ros_distortion(self) -> list[float]:
        return self.widened().ros_distortion()

    def project(self, points: Floats) -> Floats:
        return self.widened().project(points)

    def rays(self, pixels: Floats) -> Floats:
        return self.widened().rays(pixels)

    def derivatives(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        by_params, by_point, pixels = self.widened().derivatives(points)
        return by_params[:, :, :5], by_point, pixels


@pytest.fixture(scope='module')
def frames(shared_drive):
    """The shared drive, as this lens would have seen it."""
    pixels = np.stack(np.meshgrid(np.arange(640.0), np.arange(360.0)), -1).reshape(-1, 2)
    rays = np.column_stack([LENS.undistort(pixels), np.ones(len(pixels))])
    places = shared.LENS.project(rays).reshape(360, 640, 2).astype(np.float32)
    return [replace(frame, image=cv2.remap(frame.image, places, None, cv2.INTER_CUBIC))
            for frame in shared_drive.frames()]


@pytest.fixture(scope='module')
def detection(frames):
    return detect(frames, QUICK)


@pytest.fixture(scope='module')
def found(detection):
    """What comes of a model that registers itself."""
    MODELS[OneTerm.model] = OneTerm
    config = QUICK.replace({'model': 'one_term'})
    scenes = [reconstruct(turn, config, detection.valid()) for turn in detection.turns()]
    solution = solve([scene for scene in scenes if scene is not None], config)
    yield conclude(solution, evidence_of_detection(detection, scenes), config)
    del MODELS[OneTerm.model]


@pytest.mark.thorough
def test_a_model_that_registers_itself_calibrates_a_rendered_drive(found):
    assert type(found.camera) is OneTerm and list(found.sigma) == ['fx', 'fy', 'cx', 'cy', 'k1']
    assert found.verdict.level == 'accepted', found.verdict
    truth = np.array([LENS.truth[name] for name in found.camera.names()])
    sigma = np.array(list(found.sigma.values()))
    assert np.abs(found.camera.params - truth).max() < 4
    assert (np.abs(found.camera.params - truth) < 4 * sigma).all()
    assert (sigma[:2] < 0.015 * truth[:2]).all()
    # what leaves the house knows it, too
    assert result_dict(found)['camera_model'] == 'one_term'
    assert list(result_dict(found)['intrinsics']) == list(found.camera.names())
    ros = ros_camera(found.camera)
    assert ros.d == [found.camera.k1, 0.0, 0.0, 0.0, 0.0]
    assert camera_from_ros((640, 360), ros.distortion_model, ros.k, ros.d).k1 == found.camera.k1


def test_its_file_is_read_back(found, tmp_path):
    (tmp_path / 'calibration.yaml').write_text(calibration_yaml(found))
    read = load_camera(tmp_path / 'calibration.yaml').camera
    points = np.random.default_rng(1).uniform([-2, -1, 4], [2, 1, 9], (20, 3))
    np.testing.assert_allclose(read.project(points), found.camera.project(points), atol=1e-9)


def test_a_model_that_nobody_knows_is_a_config_error(detection):
    with pytest.raises(ConfigError, match='radial, brown'):
        reconstruct(detection.turns()[0], QUICK.replace({'model': 'nonsense'}))


def test_a_turn_in_the_last_seconds_of_a_drive_is_found(frames, detection):
    first = min(turn.center for turn in detection.turns())
    seen = Detection(QUICK)
    for frame in frames:
        if frame.index > first + 14:
            break
        seen.push(frame)
    assert not seen.turns()
    seen.finish()
    [found] = seen.turns()
    # fewer samples follow: the median moves the peak a little
    assert abs(found.center - first) <= 6
