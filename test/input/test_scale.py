# SPDX-License-Identifier: Apache-2.0
"""Pictures are resized so that every pixel's place is known exactly."""
from __future__ import annotations

import cv2
import numpy as np
import pytest
from refused import refused

from dashcalib_ros.config import Config
from dashcalib_ros.errors import InputError
from dashcalib_ros.input import Frame
from dashcalib_ros.input.scale import Scale, shrink_image

SCALES = [Scale(), Scale(shrink=2), Scale(shrink=4), Scale(enlarge=2), Scale(enlarge=3),
          Scale(enlarge=4)]


def resized(scale: Scale, image: np.ndarray) -> np.ndarray:
    return scale.frame(Frame(0, 0, image)).image


@pytest.mark.parametrize(('size', 'scale'), [
    ((640, 480), Scale()), ((1440, 1080), Scale()), ((1441, 1080), Scale(shrink=2)),
    ((5770, 3000), Scale(shrink=8)),
    ((639, 480), Scale(enlarge=2)), ((320, 240), Scale(enlarge=2)), ((319, 240), Scale(enlarge=3)),
    # no more than four times, however small
    ((64, 48), Scale(enlarge=4)), ((1, 1), Scale(enlarge=4)),
    # nor beyond max_width on any side
    ((480, 640), Scale(enlarge=2)), ((480, 854), Scale()), ((300, 60_000), Scale())], ids=str)
def test_how_pictures_are_resized(size, scale):
    assert Scale.of(size, Config()) == scale


def test_the_limits_are_settings():
    config = Config().replace({'min_width': 1, 'max_width': 320})
    assert Scale.of((64, 48), config) == Scale() and Scale.of((642, 362), config) == Scale(4)
    # what was halved to fit is not enlarged again
    assert Scale.of((642, 362), config.replace({'min_width': 300})) == Scale(4)
    assert Scale.of((200, 100), config.replace({'min_width': 640})) == Scale()
    with refused(InputError, 'E-IMAGE-SHAPE', '5000x1'):
        Scale.of((5000, 1), config)


@pytest.mark.parametrize('scale', SCALES, ids=str)
def test_a_pixel_is_where_the_scale_says(scale):
    """A picture that is a smooth function of the place is the same function of it afterwards."""
    def picture(x, y):
        return 128 + 60 * np.sin(x / 9 + 0.3) * np.cos(y / 7)

    small = Scale(scale.shrink).size((203, 151))
    assert scale.size((203, 151)) == (small[0] * scale.enlarge, small[1] * scale.enlarge)
    y, x = np.mgrid[:151, :203]
    found = resized(scale, np.rint(picture(x, y)).astype(np.uint8))
    assert found.dtype == np.uint8 and found.shape[::-1] == scale.size((203, 151))
    y, x = (np.mgrid[:found.shape[0], :found.shape[1]] + 0.5) * scale.px - 0.5
    inside = np.s_[5 * scale.enlarge:-5 * scale.enlarge, 5 * scale.enlarge:-5 * scale.enlarge]
    off = (found - picture(x, y))[inside]
    # the steepest slope is 7 grey values per px: half a px more or less would be 3.5; blocks of
    # 4 px are a little flatter than their middles
    assert abs(off).max() < 3 and np.sqrt(np.mean(off ** 2)) < (1.2 if scale.px == 4 else 0.6)


@pytest.mark.parametrize('factor', [2, 3, 4, 5, 6])
def test_shrinking_averages_whole_blocks(factor):
    image = np.random.default_rng(factor).integers(0, 256, (61, 79), np.uint8)
    height, width = 61 // factor, 79 // factor
    blocks = image[:height * factor, :width * factor].reshape(height, factor, width, factor)
    small = shrink_image(image, factor)
    assert small.dtype == np.uint8 and small.flags.c_contiguous
    assert np.abs(small - blocks.mean(axis=(1, 3))).max() <= 0.5
    # fewer rows or columns than a block has
    assert shrink_image(image[:1], factor).shape == (1, width)
    assert shrink_image(image[:, :1], factor).shape == (height, 1)


@pytest.mark.parametrize('factor', [2, 3, 4])
def test_a_picture_that_was_enlarged_is_found_again(factor):
    rng = np.random.default_rng(3)
    image = cv2.GaussianBlur(rng.integers(0, 256, (60, 80), np.uint8), (0, 0), 1.0)
    large = resized(Scale(enlarge=factor), image)
    again = cv2.resize(large, (80, 60), interpolation=cv2.INTER_AREA)
    assert abs(again.astype(int) - image)[5:-5, 5:-5].max() <= 6
    # no darker or brighter than a picture can be, beside the hardest edge
    hard = np.zeros((20, 20), np.uint8)
    hard[:, 10:] = 255
    large = resized(Scale(enlarge=factor), hard)
    assert large[:, :9 * factor].max() < 40 and large[:, 11 * factor:].min() > 215


@pytest.mark.parametrize('scale', SCALES, ids=str)
def test_masks_are_resized_as_pictures_are(scale):
    valid = np.ones((24, 40), bool)
    valid[9:, 17] = False
    mask = scale.mask(valid)
    assert mask.shape == (scale.size((40, 24))[1], scale.size((40, 24))[0])
    rows, columns = np.nonzero(~mask)
    assert set((np.unique(rows) * scale.px).astype(int)) == set(
        range(9 // scale.shrink * scale.shrink, 24, scale.shrink))
    assert set((np.unique(columns) * scale.px).astype(int)) == {17 // scale.shrink * scale.shrink}


def test_a_picture_of_the_right_size_is_not_copied():
    frame = Frame(3, 10**9, np.zeros((48, 64), np.uint8), 'camera')
    assert Scale().frame(frame) is frame
    large = Scale(enlarge=2).frame(frame)
    assert (large.index, large.stamp_ns, large.frame_id) == (3, 10**9, 'camera')
