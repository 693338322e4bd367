"""What a drive of made turns says of calibrations that are right and of some that are not."""
from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from solving import CONFIG, scenes_of, solved
from synthetic import LENS, SIZE

from dashcalib_ros.camera import Brown, Fisheye
from dashcalib_ros.camera.mapping import apart, as_model
from dashcalib_ros.judge import Verdict, check
from dashcalib_ros.judge.difference import Difference, answers_of, difference_of, distance
from dashcalib_ros.report import NamedCamera, compare
from dashcalib_ros.solve.spread import PictureSigma

ACCEPTED = Verdict('accepted')


@pytest.fixture(scope='module')
def solution():
    # as sharp as real pictures: noise of 0.25 px would leave 0.6 % of fx unknown
    return solved(scenes_of(4, noise_px=0.1))


def ask(given, solution, verdict=ACCEPTED):
    return check(given, SIZE, solution, verdict, CONFIG)


@pytest.mark.parametrize('shift', [0.0, 0.5, -0.5])
def test_the_truth_is_right_also_where_pixels_begin_elsewhere(solution, shift):
    found = ask(replace(LENS, cx=LENS.cx + shift, cy=LENS.cy + shift), solution)
    assert found.answer == 'right' and found.distance < found.limit
    assert found.rms_px < 1.0 and 'matters: no, with 95 %' in found.reasons[2]
    assert abs(found.loss) < 0.05


@pytest.mark.parametrize(('changes', 'way'), [
    ({'fx': 1.02 * LENS.fx}, r'focal length: fx [12]\.\d % too long'),
    ({'fx': 0.97 * LENS.fx, 'fy': 0.97 * LENS.fy}, r'focal length: [23]\.\d % too short'),
    ({'k1': LENS.k1 + 0.03}, r'distortion: off by k1 \+0\.0[23]'),
    ({'cx': LENS.cx - 12.0}, 'centre: 1'),
    ({'cy': LENS.cy + 60.0}, r'is the calibration for another part of the picture\?'),
])
def test_what_is_wrong_is_named(solution, changes, way):
    found = ask(replace(LENS, **changes), solution)
    assert found.answer == 'wrong' and found.loss > 0
    assert found.distance > found.limit and found.rms_px <= found.worst_px
    assert any(re.search(way, reason) for reason in found.reasons), found.reasons
    # nothing else is blamed: the three answers, the part, and the loss
    assert len(found.reasons) == 5 and 'matters: yes' in found.reasons[2]


def test_check_and_compare_say_the_same(solution):
    own = NamedCamera('own', solution.camera, covariance=solution.covariance,
                      sigma_px=solution.picture)
    answers = []
    for share in (0.0, 0.003, 0.01, 0.02):
        given = replace(LENS, fx=(1 + share) * LENS.fx)
        found, pair = ask(given, solution), compare(NamedCamera('given', given), own).whole
        # one implementation: the same numbers, and the same answers in the same words
        for name in ('rms_px', 'worst_px', 'sigma_px', 'told_apart', 'distance', 'limit'):
            assert getattr(found, name) == pytest.approx(getattr(pair, name)), name
        assert found.reasons[:3] == answers_of(pair, 'the drive')
        assert pair.matters == {'right': False, 'wrong': True, 'cannot tell': None}[found.answer]
        answers.append((found.told_apart, found.answer))
    assert answers[0] == (False, 'right') and answers[1][1] == 'right'
    assert answers[2][1] != 'right' and answers[3] == (True, 'wrong')


@pytest.mark.parametrize(('share', 'told', 'matters'), [
    (0.0, False, False), (0.003, True, False), (0.007, True, None), (0.01, True, True)])
def test_a_sharp_drive_tells_one_percent_of_the_focal_length(share, told, matters):
    # sigma of fx: 0.05 %; 0.3 % is more than that, but good calibrations differ by as much
    covariance = np.diag([0.0005 * LENS.fx, 0.0005 * LENS.fy, 0.3, 0.3, 0.0003, 0.0003])**2
    given = replace(LENS, fx=(1 + share) * LENS.fx)
    found = Difference(given, LENS, given.params - LENS.params, covariance, apart(given, LENS),
                       PictureSigma(0.2, 0.5))
    assert (found.told_apart, found.matters) == (told, matters)


def test_two_mistakes_are_both_named(solution):
    found = ask(replace(LENS, fx=1.03 * LENS.fx, fy=1.03 * LENS.fy, k1=LENS.k1 - 0.04), solution)
    text = '; '.join(found.reasons)
    assert found.answer == 'wrong' and 'focal length' in text and 'distortion' in text


def test_width_and_height_may_be_exchanged(solution):
    found = ask(replace(LENS, image_size=SIZE[::-1]), solution)
    assert found.answer == 'wrong' and 'are width and height exchanged' in found.reasons[0]
    assert '--crop' not in found.reasons[0]


def test_a_resized_calibration_is_recognised(solution):
    found = ask(LENS.resized(2.0, (1600, 900)), solution)
    assert found.answer == 'wrong'
    assert '1600x900' in found.reasons[0] and '--size 800x450' in found.reasons[0]
    small = LENS.resized(0.5, (400, 225))
    assert 'is wrong, too' in ask(replace(small, fx=1.05 * small.fx), solution).reasons[0]


def test_a_size_that_alone_is_wrong_is_told_without_a_number_of_pixels(solution):
    found = ask(replace(LENS, image_size=(1600, 900)), solution)
    assert found.answer == 'wrong' and 'only the size is wrong' in found.reasons[0]
    assert found.rms_px is None and found.distance is None


def test_parameters_for_another_size_than_the_file_says(solution):
    found = ask(replace(LENS.resized(0.5, (400, 225)), image_size=SIZE), solution)
    assert found.answer == 'wrong'
    assert found.reasons[0] == 'its parameters are for pictures of 400x225, and it says 800x450'


def test_a_calibration_of_larger_pictures_of_which_these_are_a_part(solution):
    whole = replace(LENS, image_size=(800, 600), cy=LENS.cy + 100)
    found = ask(whole, solution)
    x, y = (int(value) for value in found.reasons[0].split('--crop ')[1].split(',')[:2])
    assert found.answer == 'wrong' and abs(x) <= 1 and abs(y - 100) <= 1


def test_a_calibration_of_a_part(solution):
    found = ask(replace(LENS, image_size=(800, 400), cy=LENS.cy - 25), solution)
    assert found.answer == 'wrong' and 'for a part of these pictures' in found.reasons[0]


def test_another_size_needs_no_turns():
    refused = Verdict('refused', ('no turn was found',))
    found = ask(LENS.resized(2.0, (1600, 900)), None, refused)
    assert found.answer == 'wrong' and found.rms_px is None


def test_a_drive_without_a_calibration_of_its_own_cannot_tell(solution):
    for level in ('weak', 'refused'):
        found = ask(replace(LENS, fx=2 * LENS.fx), solution, Verdict(level, ('too dark',)))
        assert found.answer == 'cannot tell' and 'too dark' in found.reasons[0]


def test_a_drive_that_knows_its_camera_badly_cannot_tell(solution):
    written = replace(solution.written, left_px=np.full_like(solution.written.left_px, 30.0))
    found = ask(LENS, replace(solution, written=written))
    assert found.answer == 'cannot tell' and 'may be there' in found.reasons[2]


def test_a_distortion_that_folds_over_is_wrong(solution):
    found = ask(replace(LENS, k1=-0.9), solution)
    assert found.answer == 'wrong' and 'folds over' in found.reasons[0]


@pytest.mark.parametrize('given', [Brown.of(SIZE, [*LENS.params, 0.0, 0.0, 0.0]),
                                   as_model(LENS, Fisheye)], ids=['brown', 'fisheye'])
def test_the_same_lens_in_another_model_is_right(solution, given):
    assert ask(given, solution).answer == 'right'


def test_a_decentred_lens_is_compared_as_the_turns_see_it():
    # these turns were taken by a lens whose p1 and p2 the solution does not have
    true = Brown.of(SIZE, [*LENS.params, 0.002, -0.002, 0.0])
    solution = solved(scenes_of(4, extra=(0.002, -0.002, 0.0)),
                      CONFIG.replace({'model': 'radial'}))
    found = difference_of(true, solution, 1.0)
    plain = difference_of(LENS, solution, 1.0)
    assert found.distance < found.limit < plain.distance


def test_pixels_are_those_of_the_input(solution):
    given = LENS.with_focal(1.01 * LENS.fx)
    small = difference_of(given, solution, 1.0)
    large = difference_of(given.resized(2.0, (1600, 900)), solution, 2.0)
    assert large.rms_px == pytest.approx(2 * small.rms_px, rel=2e-3)
    assert large.relevant_px == pytest.approx(2 * small.relevant_px, rel=2e-3)
    assert large.offsets[0] == pytest.approx(2 * small.offsets[0], rel=1e-3)
    assert large.offsets[4] == pytest.approx(small.offsets[4], rel=1e-3)


def test_the_part_that_explains_most_comes_first():
    covariance = np.diag([1.0, 1.0, 1.0, 1.0, 0.01, 0.01])
    # fx and k1 are known together only: k1, as it is, leads one to expect fx 0.9 larger
    covariance[0, 4] = covariance[4, 0] = 0.09
    offsets = np.array([9.0, 0.0, 0.0, 30.0, 0.1, 0.0])
    found = Difference(LENS, LENS, offsets, covariance, None, PictureSigma(0.1, 0.2))
    ways = found.ways()
    assert list(ways) == ['centre', 'focal length']
    np.testing.assert_allclose(ways['centre'], [0.0, 30.0], atol=1e-9)
    np.testing.assert_allclose(ways['focal length'], [8.1, 0.0], atol=1e-9)
    assert distance(np.zeros(0), np.zeros((0, 0))) == 0.0
