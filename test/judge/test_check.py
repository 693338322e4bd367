# SPDX-License-Identifier: Apache-2.0
"""What a drive of made turns says about calibrations that are right and of some that are not."""
from __future__ import annotations

import re
import shlex
import sys
from dataclasses import replace

import numpy as np
import pytest
from solving import CONFIG, remembered, scenes_of, solved
from synthetic import LENS, SIZE

from dashcalib_ros.camera import Brown, Fisheye, Radial, misread
from dashcalib_ros.camera.mapping import apart, as_model
from dashcalib_ros.errors import Notice
from dashcalib_ros.judge import Check, Verdict, check, with_faults
from dashcalib_ros.judge.difference import (
    SURE,
    Difference,
    answers_of,
    difference_of,
    distance,
    reasons_of,
)
from dashcalib_ros.report import NamedCamera, compare
from dashcalib_ros.report.compare import answers
from dashcalib_ros.solve import start
from dashcalib_ros.solve.spread import PictureSigma

ACCEPTED = Verdict('accepted')


@pytest.fixture(scope='module')
def solution():
    # as sharp as real pictures: noise of 0.25 px would leave 0.6 % of fx unknown
    return solved(scenes_of(4, noise_px=0.1))


@pytest.fixture(scope='module', autouse=True)
def adjusted_once():
    """Adjust the turns once to each camera that is asked about."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(start, 'costs_with', remembered(start.costs_with))
        yield


def ask(given, solution, verdict=ACCEPTED):
    return check(given, SIZE, solution, verdict, CONFIG)


@pytest.mark.parametrize('shift', [0.0, 0.5, -0.5])
def test_the_truth_is_right_also_where_pixels_begin_elsewhere(solution, shift):
    found = ask(replace(LENS, cx=LENS.cx + shift, cy=LENS.cy + shift), solution)
    assert found.answer == 'right' and found.distance < found.limit
    assert found.rms_px < 1.0 and 'detection' in found.good_for
    assert abs(found.loss) < 0.05


@pytest.mark.parametrize(('changes', 'way'), [
    ({'fx': 1.02 * LENS.fx}, r'focal length: fx [12]\.\d ± 0\.\d % too long'),
    ({'fx': 0.97 * LENS.fx, 'fy': 0.97 * LENS.fy}, r'focal length: [23]\.\d ± 0\.\d % too short'),
    ({'k1': LENS.k1 + 0.03}, r'distortion: off by k1 \+0\.0[23]\d* ± 0\.0'),
    ({'cx': LENS.cx - 12.0}, 'centre: 1'),
    ({'cy': LENS.cy + 60.0}, r'is the calibration for another part of the picture\?'),
])
def test_what_is_wrong_is_named(solution, changes, way):
    found = ask(replace(LENS, **changes), solution)
    assert found.answer == 'wrong' and found.loss > 0
    assert found.distance > found.limit and found.rms_px <= found.worst_px
    assert any(re.search(way, reason) for reason in found.reasons), found.reasons
    # nothing else is blamed: the answer, the distance, the limits, the part, and the loss
    assert len(found.reasons) == 5 and way.partition(':')[0].startswith(
        ('is the', found.reasons[0].rpartition('because of the ')[2]))


SEVERITY = {'right': 0, 'differs': 1, 'wrong': 2}
SHARES = (0.0, 0.003, 0.006, 0.01, 0.02, 0.05)
# what is changed, by a share of the focal length, of the width, and of 1
POPULATION = {
    'focal length': lambda camera, share: camera.with_focal((1 + share) * camera.fx),
    'fx': lambda camera, share: replace(camera, fx=(1 + share) * camera.fx),
    'centre': lambda camera, share: replace(camera, cx=camera.cx + share * SIZE[0]),
    'k1': lambda camera, share: replace(camera, k1=camera.k1 + share)}


@pytest.mark.parametrize('sign', [1, pytest.param(-1, marks=pytest.mark.thorough)])
@pytest.mark.parametrize('way', POPULATION)
@pytest.mark.parametrize('noise', ['sharp', 'soft'])
def test_the_farther_off_the_graver_the_answer(solution, noise, way, sign):
    if noise == 'soft':
        # what the turns do not determine so well: sigma over the picture of about 0.6 %
        solution = replace(solution, written=replace(
            solution.written, loose=solution.written.loose + 36 * solution.covariance))
    own = solution.camera
    found = [ask(POPULATION[way](own, sign * share), solution) for share in SHARES]
    answers = [SEVERITY[each.answer] for each in found if each.answer != 'cannot tell']
    assert answers == sorted(answers)
    assert found[0].answer == 'right' and found[-1].answer == 'wrong'
    if way in ('focal length', 'fx'):
        # 2 % are wrong for every use, and never right
        assert found[-2].answer == 'wrong'
    for each in found:
        # the words are those of the numbers beside them
        assert each.told_apart == (each.distance > each.limit)
        assert (each.answer in ('right', 'differs')) <= ('detection' in each.good_for)
        for use, limit in each.limits_px.items():
            assert (use in each.good_for) == (each.answer != 'wrong' and each.rms_px <= limit
                                              and each.bound_px <= SURE * limit)


def test_a_small_difference_is_not_called_wrong_where_the_drive_knows_little():
    # k1 is known well, and the focal length to 2 %: the difference is real, its size is not known
    covariance = np.diag([0.02 * LENS.fx, 0.02 * LENS.fy, 0.3, 0.3, 0.0003, 0.0003])**2
    given = replace(LENS, k1=LENS.k1 + 0.005)
    found = Difference(given, LENS, given.params - LENS.params, covariance, apart(given, LENS),
                       PictureSigma(5.0, 9.0))
    assert found.told_apart and found.rms_px < found.limits_px['detection']
    assert (found.answer, found.matters, found.good_for) == ('cannot tell', None, ())
    assert 'may be too large' in answers_of(found, '')[0]


def test_the_middle_answer_is_given(solution):
    found = ask(solution.camera.with_focal(1.006 * solution.camera.fx), solution)
    assert (found.answer, found.good_for, found.told_apart) == ('differs', ('detection',), True)
    assert 'good enough for detection' in str(found.reasons[0])
    for value in (found.distance, found.limit):
        assert f'{value:.1f}' in str(found.reasons[1])
    for value in (found.rms_px, found.bound_px, *found.limits_px.values()):
        assert f'{value:.2f}' in str(found.reasons[2])


def test_a_camera_that_explains_the_turns_as_well_is_not_called_wrong(solution, monkeypatch):
    far = LENS.with_focal(1.05 * LENS.fx)
    # judge.check is the function, too
    monkeypatch.setattr(sys.modules['dashcalib_ros.judge.check'], 'loss_of', lambda *_: -0.07)
    found = ask(far, solution)
    assert found.answer == 'cannot tell' and found.rms_px > found.limits_px['detection']
    assert 'wrong' not in str(found.reasons[0]) and '7.0 % smaller' in str(found.reasons[-1])


def test_check_and_compare_say_the_same(solution):
    own = NamedCamera('own', solution.camera, covariance=solution.covariance,
                      sigma_px=solution.picture)
    answers = []
    for share in (0.0, 0.003, 0.01, 0.02):
        given = replace(LENS, fx=(1 + share) * LENS.fx)
        found, pair = ask(given, solution), compare(NamedCamera('given', given), own).whole
        # one implementation: the same numbers, and the same answers in the same words
        for name in ('rms_px', 'worst_px', 'sigma_px', 'told_apart', 'distance', 'limit',
                     'bound_px', 'limits_px', 'good_for'):
            assert getattr(found, name) == pytest.approx(getattr(pair, name)), name
        assert found.reasons[:3] == answers_of(pair, 'the drive')
        assert found.answer == pair.answer
        answers.append((found.told_apart, found.answer))
    assert answers[0] == (False, 'right') and answers[3] == (True, 'wrong')
    assert answers[2] == (True, 'differs')


@pytest.mark.parametrize(('share', 'answer', 'matters'), [
    (0.0, 'right', False), (0.001, 'right', False), (0.003, 'differs', False),
    (0.009, 'differs', False), (0.011, 'wrong', True)])
def test_a_sharp_drive_sees_tenths_of_a_percent_of_the_focal_length(share, answer, matters):
    # sigma of fx: 0.05 %
    covariance = np.diag([0.0005 * LENS.fx, 0.0005 * LENS.fy, 0.3, 0.3, 0.0003, 0.0003])**2
    given = LENS.with_focal((1 + share) * LENS.fx)
    found = Difference(given, LENS, given.params - LENS.params, covariance, apart(given, LENS),
                       PictureSigma(0.2, 0.5))
    assert (found.answer, found.matters) == (answer, matters)


@pytest.mark.parametrize(('offset', 'sigma', 'answer'), [
    (7.0, 0.3, 'differs'), (10.0, 0.3, 'wrong'), (10.0, 2.0, 'differs')])
def test_a_centre_that_is_shown_to_be_far_off_is_wrong(offset, sigma, answer):
    # over the picture, hardly a pixel of it is left: it looks like a camera that is turned
    covariance = np.diag([0.2, 0.2, sigma, sigma, 0.0003, 0.0003])**2
    given = replace(LENS, cx=LENS.cx + offset)
    found = Difference(given, LENS, given.params - LENS.params, covariance, apart(given, LENS),
                       PictureSigma(0.1, 0.2))
    assert found.answer == answer and bool(found.good_for) == (answer != 'wrong')
    assert ('centre is off' in answers_of(found, '')[2]) == (answer == 'wrong')


def test_two_mistakes_are_both_named(solution):
    found = ask(replace(LENS, fx=1.03 * LENS.fx, fy=1.03 * LENS.fy, k1=LENS.k1 - 0.04), solution)
    text = '; '.join(found.reasons)
    assert found.answer == 'wrong' and 'focal length' in text and 'distortion' in text


def test_width_and_height_may_be_exchanged(solution):
    found = ask(replace(LENS, image_size=SIZE[::-1]), solution)
    assert found.answer == 'wrong' and 'are width and height exchanged' in str(found.reasons[0])
    assert '--crop' not in str(found.reasons[0])


def test_a_resized_calibration_is_recognised(solution):
    found = ask(LENS.resized(2.0, (1600, 900)), solution)
    assert found.answer == 'wrong'
    assert '1600x900' in str(found.reasons[0])
    assert 'dashcalib export CALIBRATION --to ros --size 800x450 --out ' in str(found.reasons[0])
    name = "my cam's.yaml"
    named = check(LENS.resized(2.0, (1600, 900)), SIZE, solution, ACCEPTED, CONFIG, name=name)
    command = shlex.split(named.reasons[0].partition('px): ')[2])
    assert command[:6] == ['dashcalib', 'export', name, '--to', 'ros', '--size']
    small = LENS.resized(0.5, (400, 225))
    assert 'is wrong, too' in ask(replace(small, fx=1.05 * small.fx), solution).reasons[0]


def test_a_size_that_alone_is_wrong_is_told_without_a_number_of_pixels(solution):
    found = ask(replace(LENS, image_size=(1600, 900)), solution)
    assert found.answer == 'wrong' and 'only the size is wrong' in str(found.reasons[0])
    assert found.rms_px is None and found.distance is None


def test_parameters_for_another_size_than_the_file_says(solution):
    found = ask(replace(LENS.resized(0.5, (400, 225)), image_size=SIZE), solution)
    assert found.answer == 'wrong'
    assert '400x225' in str(found.reasons[0]) and '800x450' in str(found.reasons[0])


def test_a_calibration_of_larger_pictures_of_which_these_are_a_part(solution):
    whole = replace(LENS, image_size=(800, 600), cy=LENS.cy + 100)
    found = ask(whole, solution)
    x, y = (int(value) for value in str(found.reasons[0]).split('--crop ')[1].split(',')[:2])
    assert found.answer == 'wrong' and abs(x) <= 1 and abs(y - 100) <= 1


def test_a_calibration_of_a_part(solution):
    found = ask(replace(LENS, image_size=(800, 400), cy=LENS.cy - 25), solution)
    assert found.answer == 'wrong' and 'for a part of these pictures' in str(found.reasons[0])


def test_another_size_needs_no_turns():
    refused = Verdict('refused', (Notice('', 'no turn was found'),))
    found = ask(LENS.resized(2.0, (1600, 900)), None, refused)
    assert found.answer == 'wrong' and found.rms_px is None
    assert '--size 800x450' in str(found.reasons[0])


def test_a_drive_without_a_calibration_of_its_own_cannot_tell(solution):
    for level in ('weak', 'refused'):
        verdict = Verdict(level, (Notice('', 'too dark'),))
        found = ask(replace(LENS, fx=2 * LENS.fx), solution, verdict)
        assert found.answer == 'cannot tell' and 'too dark' in str(found.reasons[0])


def test_a_drive_that_knows_its_camera_badly_cannot_tell(solution):
    written = replace(solution.written, left_px=np.full_like(solution.written.left_px, 30.0))
    found = ask(LENS, replace(solution, written=written))
    assert found.answer == 'cannot tell' and not found.told_apart
    assert found.bound_px > SURE * found.limits_px['detection']


def test_a_distortion_that_folds_over_is_wrong(solution):
    found = ask(replace(LENS, k1=-0.9), solution)
    assert found.answer == 'wrong' and 'folds over' in str(found.reasons[0])


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
    assert large.limits_px['mapping'] == pytest.approx(2 * small.limits_px['mapping'], rel=2e-3)
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
    np.testing.assert_allclose(ways['centre'], [[0.0, 30.0], [1.0, 1.0]], atol=1e-9)
    # and its sigma is what k1 leaves: sqrt(1 - 0.9^2)
    np.testing.assert_allclose(ways['focal length'], [[8.1, 0.0], [0.19**0.5, 1.0]], atol=1e-9)
    assert distance(np.zeros(0), np.zeros((0, 0))) == 0.0


def test_coefficients_that_compensate_each_other_stand_with_what_is_known_of_them():
    # k1 and k2 together are known ten times better than each alone
    covariance = np.diag([1.0, 1.0, 1.0, 1.0, 4e-4, 1.6e-3])
    covariance[4, 5] = covariance[5, 4] = -0.99 * np.sqrt(4e-4 * 1.6e-3)
    found = Difference(LENS, LENS, np.array([0, 0, 0, 0, 0.03, 0.04]), covariance, apart(
        replace(LENS, k1=LENS.k1 + 0.03), LENS), PictureSigma(0.1, 0.2))
    [text] = [each for each in reasons_of(found) if each.startswith('distortion')]
    assert 'k1 +0.030 ± 0.020' in text and 'k2 +0.040 ± 0.040' in text
    alone = replace(found, covariance=np.diag([1.0, 1.0, 1.0, 1.0, 1e-6, 1.0]))
    [text] = [each for each in reasons_of(alone) if each.startswith('distortion')]
    assert 'k1 +0.0300 ± 0.0010' in text and 'k2' not in text


@pytest.mark.parametrize('given', [as_model(LENS, Fisheye), LENS], ids=['fisheye', 'radial'])
def test_a_distortion_model_that_is_the_wrong_one_is_named(given):
    # a strong lens: with the numbers read as those of the other family, it is far off
    strong = replace(LENS, k1=-0.2, k2=0.03)
    right = strong if given is LENS else as_model(strong, Fisheye)
    wrong = misread(right)
    found = compare(NamedCamera('a', wrong), NamedCamera('b', right))
    other = right.ros_model
    assert found.answer == 'wrong' and f'read as {other}' in found.misread
    assert found.misread in answers(found)[-1] and found.to_dict()['misread'] == found.misread
    assert not compare(NamedCamera('b', right), NamedCamera('b', right)).misread
    far = NamedCamera('c', replace(right, fx=1.1 * right.fx, fy=1.1 * right.fy))
    assert not compare(NamedCamera('a', wrong), far).misread


def test_check_names_the_wrong_distortion_model(solution):
    own = solution.camera
    assert isinstance(own, Radial)
    found = ask(misread(own), solution)
    assert found.answer == 'wrong' and 'distortion_model' in found.next_step
    assert any('read as plumb_bob instead of equidistant' in str(each) for each in found.reasons)


@pytest.mark.parametrize(('answer', 'good_for', 'words'), [
    ('right', ('detection', 'mapping', 'metrology'), ('keep it for detection, mapping',)),
    ('right', ('detection',), ('keep it for detection; for mapping, metrology:', 'more turns')),
    ('differs', ('detection',), ('keep it for detection; for mapping, metrology:', 'replace it')),
    ('wrong', (), ('replace it', 'dashcalib run')), ('cannot tell', (), ('sharper turns',)),
    ('right', (), ('keep it',))])
def test_an_answer_ends_with_what_to_do(answer, good_for, words):
    limits = dict.fromkeys(('detection', 'mapping', 'metrology'), 1.0) if good_for else {}
    found = Check(answer, ('why',), limits_px=limits, good_for=good_for)
    assert all(each in found.next_step for each in words)
    faulty = with_faults(found, ('R is not a rotation',))
    assert (faulty.answer, faulty.good_for) == ('wrong', ()) and 'correct' in faulty.next_step
