# SPDX-License-Identifier: Apache-2.0
"""The user's segmentation model: what it is given, how it adds up, how a bad one is named."""
from __future__ import annotations

import itertools
import os
import sys

import cv2
import numpy as np
import pytest
from onnx_models import map_model, picky_model, pixel_model
from refused import refused

from dashcalib_ros import Calibrator, Config
from dashcalib_ros.cli import main
from dashcalib_ros.config import MaskConfig, TrackingConfig
from dashcalib_ros.detect import MotionEstimator
from dashcalib_ros.detect.segmentation import (
    IMAGES,
    PERIOD_S,
    SegmentationMask,
    SegmentationModel,
    open_segmentation,
)
from dashcalib_ros.errors import ConfigError, InputError
from dashcalib_ros.input import Frame

HEIGHT, WIDTH = 288, 512
SECOND = 10**9


def street(count, rate=10.0, seed=0):
    """Return pictures of a world that shifts to the left, 5 px each."""
    rng = np.random.default_rng(seed)
    world = cv2.GaussianBlur(rng.uniform(0, 255, (HEIGHT, WIDTH + 5 * count)), (0, 0), 2.0)
    world = cv2.normalize(world, None, 60, 250, cv2.NORM_MINMAX).astype(np.uint8)
    return [Frame(k, round(k * SECOND / rate), world[:, 5 * k:5 * k + WIDTH].copy())
            for k in range(count)]


def picture_with(rows):
    picture = np.full((HEIGHT, WIDTH), 120, np.uint8)
    picture[rows] = 0
    return picture


@pytest.fixture
def dark(tmp_path):
    """Make a model that takes what is black for the vehicle."""
    return pixel_model(tmp_path / 'dark.onnx')


@pytest.mark.parametrize('options', [
    {}, {'size': (144, 256)}, {'size': ('h', 256)}, {'labels': True}, {'batch': 'n'},
    {'stride': 4}, {'classes': 66, 'vehicle': 63}, {'planes': 3, 'size': (1088, 1920)}])
def test_every_usual_shape_of_model_finds_the_bonnet(tmp_path, options):
    model = SegmentationModel(pixel_model(tmp_path / 'm.onnx', **options), '63,64')
    mask = SegmentationMask(model, MaskConfig())
    assert mask.hidden((HEIGHT, WIDTH)) is None and mask.warning() is None
    assert mask.push(picture_with(np.s_[230:]), 0)
    hidden = mask.hidden((HEIGHT, WIDTH))
    assert hidden.shape == (HEIGHT, WIDTH) and mask.warning() is None
    # a margin of 1 % of the width beyond the outline
    assert hidden[226:].all() and not hidden[:220].any()


def test_labels_with_a_plane_of_their_own(tmp_path):
    labels = np.zeros((1, 1, 9, 16), np.int64)
    labels[:, :, 7:] = 64
    vehicle = SegmentationModel(map_model(tmp_path / 'm.onnx', labels), '64').vehicle(
        picture_with(np.s_[:0]))
    assert np.array_equal(vehicle, labels[0, 0] == 64)


def test_logits_that_are_no_numbers_are_no_vehicle(tmp_path):
    logits = np.zeros((1, 65, 9, 16), np.float32)
    logits[0, 64, 5:] = 1.0
    logits[0, 3, 5:, :8] = np.nan
    logits[0, 0, :5] = 1.0
    vehicle = SegmentationModel(map_model(tmp_path / 'm.onnx', logits), '63,64').vehicle(
        picture_with(np.s_[:0]))
    assert vehicle[5:, 8:].all() and not vehicle[:5].any() and not vehicle[:, :8].any()


def test_the_network_gets_the_picture_as_it_learned_it(tmp_path):
    """Whichever the threshold, the grey levels on either side of it are told apart."""
    picture = picture_with(np.s_[:0])
    picture[:, :256] = 99
    picture[:, 256:] = 101
    model = SegmentationModel(pixel_model(tmp_path / 'm.onnx', threshold=100.0), '64')
    vehicle = model.vehicle(picture)
    middle = vehicle.shape[1] // 2
    assert vehicle[:, :middle - 4].all() and not vehicle[:, middle + 4:].any()


def test_cars_that_pass_are_outvoted_and_the_last_vote_is_final(dark):
    mask = SegmentationMask(SegmentationModel(dark, '64'), MaskConfig())
    asked = []
    for k in range(200):
        picture = picture_with(np.s_[230:])
        if (k // 10) % 3 == 0:
            picture[100:150, 200:300] = 0
        if mask.push(picture, k * SECOND // 4):
            asked.append(k)
    apart = round(4 * PERIOD_S)
    assert asked == [apart * n for n in range(IMAGES)]
    hidden = mask.hidden((HEIGHT, WIDTH))
    assert hidden[230:].all() and not hidden[:220].any()


def test_a_clock_that_is_set_back_does_not_end_the_votes(dark):
    mask = SegmentationMask(SegmentationModel(dark, '64'), MaskConfig())
    assert mask.push(picture_with(np.s_[230:]), 100 * SECOND)
    assert mask.push(picture_with(np.s_[230:]), 0)
    assert not mask.push(picture_with(np.s_[230:]), SECOND)


def test_what_is_not_believed_or_not_there_is_said(dark):
    model = SegmentationModel(dark, '64')
    for rows, code in ((np.s_[60:], 'E-SEGMENTATION-TOO-LARGE'),
                       (np.s_[:0], 'E-SEGMENTATION-EMPTY')):
        mask = SegmentationMask(model, MaskConfig())
        mask.push(picture_with(rows), 0)
        assert mask.hidden((HEIGHT, WIDTH)) is None
        assert mask.warning().code == code
        assert ('79 %' in str(mask.warning())) == (code == 'E-SEGMENTATION-TOO-LARGE')


def test_only_a_car_that_moves_asks(dark):
    estimator = MotionEstimator(TrackingConfig(), MaskConfig(enabled=False, segmentation=dark))
    [first, *_] = street(1)
    first.image[230:] = 0
    for k in range(50):
        estimator.push(Frame(k, k * SECOND // 10, first.image))
    assert estimator.valid() is None and estimator.warnings() == ()


@pytest.mark.parametrize(('user', 'automatic', 'model'),
                         [*itertools.product([False, True], repeat=3)])
def test_masks_in_all_combinations(tmp_path, user, automatic, model):
    """Each hides its own part; together they hide all of them."""
    labels = np.zeros((1, HEIGHT, WIDTH), np.int64)
    labels[0, :, :40] = 64
    path = map_model(tmp_path / 'left.onnx', labels) if model else ''
    given = np.ones((HEIGHT, WIDTH), bool)
    given[:20] = False
    frames = street(120)
    text = np.random.default_rng(1).integers(0, 2, (60, 160)).astype(np.uint8) * 255
    for frame in frames:
        frame.image[-60:, 240:400] = cv2.blur(text, (3, 3))  # keeps its place
    estimator = MotionEstimator(
        TrackingConfig(), MaskConfig(enabled=automatic, segmentation=path),
        given if user else None)
    for frame in frames:
        estimator.push(frame)
    valid = estimator.valid()
    if not (user or automatic or model):
        assert valid is None
        return
    assert (not valid[:20].any()) == user
    assert (not valid[-50:-4, 250:390].any()) == automatic
    assert (not valid[:, :40].any()) == model
    assert valid[30:200, 60:].all()
    # what is hidden is not tracked either
    column, row = np.rint(estimator._xy).astype(int).T
    assert len(row) > 50 and valid[row, column].all()


def test_pictures_of_another_size_are_asked_about_anew(dark):
    estimator = MotionEstimator(TrackingConfig(), MaskConfig(enabled=False, segmentation=dark))
    for frame in street(20):
        frame.image[230:] = 0
        estimator.push(frame)
    assert not estimator.valid()[230:].any()
    for frame in street(20):
        estimator.push(Frame(frame.index, frame.stamp_ns, frame.image[:200, :400]))
    assert estimator.valid() is None


def test_a_users_mask_of_another_size_is_refused_as_before(dark):
    config = MaskConfig(segmentation=dark)
    estimator = MotionEstimator(TrackingConfig(), config, np.ones((8, 8), bool))
    with pytest.raises(InputError):
        estimator.push(street(1)[0])


def test_the_core_uses_it_and_says_what_was_odd(tmp_path):
    frames = street(30)
    for frame in frames:
        frame.image[230:] = 0
    config = Config().replace({'mask.segmentation': pixel_model(tmp_path / 'm.onnx'),
                               'mask.enabled': False})
    with Calibrator(config) as calibrator:
        for frame in frames:
            calibrator.push(frame)
        result = calibrator.calibrate()
    assert not result.mask[230:].any() and result.mask[:220].all() and result.warnings == ()
    with Calibrator(config.replace({'mask.segmentation_classes': '7'})) as calibrator:
        for frame in frames:
            calibrator.push(frame)
        result = calibrator.calibrate()
    assert result.mask is None and result.warnings[0].code.startswith('E-SEGMENTATION-')


def test_a_model_is_loaded_once_for_a_node_that_begins_anew(dark):
    config = MaskConfig(segmentation=dark)
    assert open_segmentation(config) is open_segmentation(config)
    assert open_segmentation(MaskConfig()) is None


@pytest.fixture
def drive(tmp_path, monkeypatch):
    """Make a folder of four pictures and go to an empty folder beside it."""
    (tmp_path / 'drive').mkdir()
    (tmp_path / 'work').mkdir()
    monkeypatch.chdir(tmp_path / 'work')
    for frame in street(4):
        cv2.imwrite(str(tmp_path / 'drive' / f'{frame.index}.png'), frame.image)
    return str(tmp_path / 'drive')


BAD = {
    'cut off': lambda path: path.write_bytes(b'\x08\x08' * 50),
    'empty': lambda path: path.write_bytes(b''),
    'a folder': lambda path: path.mkdir(),
    'one plane': lambda path: pixel_model(path, planes=1),
    'a batch of four': lambda path: pixel_model(path, batch=4),
    'bytes': lambda path: map_model(path, np.zeros((1, 8, 8), np.int64), takes='uint8'),
    'a classifier': lambda path: map_model(path, np.zeros((1, 1000), np.float32)),
    'one class': lambda path: map_model(path, np.zeros((1, 1, 8, 8), np.float32)),
    'float labels': lambda path: map_model(path, np.zeros((1, 8, 8), np.float32)),
    'last axis classes': lambda path: map_model(path, np.zeros((2, 8, 8), np.int64)),
    '19 classes': lambda path: pixel_model(path, classes=19, vehicle=13),
    'another size': picky_model,
}
CODES = {
    'cut off': ('E-SEGMENTATION-UNREADABLE', ''), 'empty': ('E-SEGMENTATION-UNREADABLE', ''),
    'a folder': ('E-FILE-NOT-REGULAR', ''), 'one plane': ('E-SEGMENTATION-INPUT', '1x1xhxw'),
    'a batch of four': ('E-SEGMENTATION-INPUT', '4x3xhxw'),
    'bytes': ('E-SEGMENTATION-INPUT', 'uint8'),
    'a classifier': ('E-SEGMENTATION-OUTPUT', '1x1000'),
    'one class': ('E-SEGMENTATION-OUTPUT', '1x1x8x8'),
    'float labels': ('E-SEGMENTATION-OUTPUT', '1x8x8'),
    'last axis classes': ('E-SEGMENTATION-OUTPUT', '2x8x8'),
    '19 classes': ('E-SEGMENTATION-CLASSES', '0 to 18'),
    'another size': ('E-SEGMENTATION-FAILED', ''),
}


@pytest.mark.parametrize('command', ['run', 'turns'])
@pytest.mark.parametrize('kind', BAD)
def test_a_model_of_no_use_is_refused_at_the_start(drive, tmp_path, capfd, kind, command):
    path = tmp_path / 'model.onnx'
    BAD[kind](path)
    (tmp_path / 'drive' / '0.png').write_bytes(b'')  # what would be said if it were read
    assert main([command, drive, '--fps', '10', '--segmentation', str(path)]) == 2
    shown = capfd.readouterr()
    assert shown.err.startswith('dashcalib: error: ') and shown.err.count('\n') == 1, shown.err
    code, value = CODES[kind]
    assert shown.err.endswith(f' [{code}]\n'), shown.err
    assert value in shown.err and len(shown.err) < 500, shown.err
    assert shown.out == '' and not list((tmp_path / 'work').iterdir())


@pytest.mark.parametrize('path', ['none.onnx', '~nobody-of-this-name/none.onnx'])
def test_a_model_that_is_not_there(drive, capfd, path):
    assert main(['run', drive, '--segmentation', path]) == 2
    shown = capfd.readouterr().err
    assert path in shown and shown.endswith(' [E-SEGMENTATION-PATH]\n')


def test_a_model_that_would_be_waited_for(drive, tmp_path, capfd):
    os.mkfifo(tmp_path / 'pipe.onnx')
    for path in (tmp_path / 'pipe.onnx', '/dev/full'):
        assert main(['run', drive, '--segmentation', str(path)]) == 2
        assert capfd.readouterr().err.endswith(' [E-FILE-NOT-REGULAR]\n')


def test_without_the_runtime_the_cure_is_named(drive, tmp_path, monkeypatch, capfd):
    (tmp_path / 'model.onnx').write_bytes(b'never read')
    monkeypatch.setitem(sys.modules, 'onnxruntime', None)
    assert main(['run', drive, '--segmentation', str(tmp_path / 'model.onnx')]) == 2
    shown = capfd.readouterr().err
    assert shown.endswith('pip install onnxruntime [E-EXTRA-NOT-INSTALLED]\n')


def test_the_runtime_is_not_loaded_without_a_model(monkeypatch):
    monkeypatch.setitem(sys.modules, 'onnxruntime', None)
    MotionEstimator(TrackingConfig())


@pytest.mark.parametrize('classes', [13, '13', '63,64', '63, 64'])
def test_classes_as_people_write_them(tmp_path, classes):
    config = Config().replace({'mask.segmentation_classes': classes})
    assert config.mask.segmentation_classes == str(classes)


@pytest.mark.parametrize('classes', ['', 'car', '63;64', '63,', '-1', '1.5', '12345'])
def test_classes_that_are_none(classes):
    with refused(ConfigError, 'E-CONFIG-PATTERN', '63,64'):
        Config().replace({'mask.segmentation_classes': classes})


def test_the_node_takes_it_as_a_parameter(start_node, tmp_path):
    path = pixel_model(tmp_path / 'model.onnx', classes=19, vehicle=13)
    # a number, as ROS types it
    start_node(mask__segmentation=path, mask__segmentation_classes=13).wait_for('learning')


def test_the_node_refuses_a_bad_model_with_one_line(start_node, tmp_path):
    path = pixel_model(tmp_path / 'model.onnx', classes=19, vehicle=13)
    for given, value in ((path, 'mask.segmentation_classes'), ('none.onnx', 'none.onnx')):
        node = start_node(mask__segmentation=given)
        assert node.process.wait(20) == 2
        assert value in node.text and len(node.text.splitlines()) == 1, node.text
