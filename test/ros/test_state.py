# SPDX-License-Identifier: Apache-2.0
"""When a calibration is adopted, kept, replaced or given up: no ROS needed."""
from __future__ import annotations

import dataclasses

import pytest

from dashcalib_ros.camera import Brown, Fisheye, Radial
from dashcalib_ros.camera.mapping import as_model
from dashcalib_ros.config import Config
from dashcalib_ros.errors import Notice
from dashcalib_ros.judge import Verdict
from dashcalib_ros.judge.difference import contradicted
from dashcalib_ros.judge.verdict import MOVES, STEADY
from dashcalib_ros.report import Calibration, NamedCamera
from dashcalib_ros.ros.settings import NodeConfig
from dashcalib_ros.ros.state import judge, sigma_text

RULES = NodeConfig(better=0.7, contradictions=3)
TRUTH = Radial((640, 360), 400.0, 401.0, 320.0, 180.0, -0.3, 0.1)
SIGMA = {'fx': 2.0, 'fy': 2.0, 'cx': 2.0, 'cy': 2.0, 'k1': 0.01, 'k2': 0.01}
OLD = NamedCamera('old', TRUTH, SIGMA, 'accepted')


def calibration(level='accepted', sigma=SIGMA, **changes):
    camera = dataclasses.replace(TRUTH, **changes) if level != 'refused' else None
    reasons = () if level == 'accepted' else (Notice('', 'few turns'),)
    return Calibration(Verdict(level, reasons), (640, 360), camera, sigma if camera else None, (),
                       10, 0.3, {}, {}, Config())


def test_the_first_accepted_one_is_adopted_and_no_other():
    assert judge(calibration(), True, None, 0, RULES).action == 'adopt'
    assert judge(calibration(), False, None, 0, RULES).action == 'adopt'
    for level in ('weak', 'refused'):
        judged = judge(calibration(level), True, None, 0, RULES)
        assert (judged.action, judged.why) == ('wait', 'few turns')


def test_one_that_is_not_accepted_changes_nothing():
    judged = judge(calibration('weak', fx=500.0), True, OLD, 2, RULES)
    assert (judged.action, judged.contradictions) == ('keep', 2)


@pytest.mark.parametrize(('ratio', 'action'), [(0.69, 'replace'), (0.71, 'keep'), (1.5, 'keep')])
def test_a_confirming_one_replaces_it_only_when_clearly_better(ratio, action):
    sigma = {**SIGMA, 'fx': ratio * SIGMA['fx']}
    assert judge(calibration(sigma=sigma), True, OLD, 0, RULES).action == action
    # too few turns to replace anything
    assert judge(calibration(sigma=sigma), False, OLD, 0, RULES).action == 'keep'


def test_contradictions_in_a_row_give_it_up():
    count = 0
    for expected in ('keep', 'keep', 'give_up'):
        judged = judge(calibration(fx=440.0), False, OLD, count, RULES)
        count = judged.contradictions
        assert judged.action == expected and 'fx 440.0 instead of 400.0' in judged.why


def test_a_stabiliser_that_is_switched_on_gives_it_up():
    weak = calibration('weak')
    verdict = Verdict('weak', (Notice(MOVES, 'the picture moves', STEADY),))
    moving = dataclasses.replace(weak, verdict=verdict)
    for count in (0, 1):
        judged = judge(moving, True, OLD, count, RULES)
        assert judged.action == 'keep' and judged.contradictions == count + 1
        assert STEADY in judged.why
    assert judge(moving, True, OLD, 2, RULES).action == 'give_up'
    assert judge(moving, True, None, 0, RULES).action == 'wait'


def test_a_confirmation_in_between_begins_the_count_anew():
    assert judge(calibration(), False, OLD, 2, RULES).contradictions == 0


def test_the_last_contradiction_replaces_it_when_its_turns_suffice():
    assert judge(calibration(fx=440.0), True, OLD, 2, RULES).action == 'replace'


@pytest.mark.parametrize(('change', 'found'), [
    ({'fx': 408.0}, False),            # 8 px are less than 3 * hypot(2, 2)
    ({'fx': 409.0}, True),
    ({'cx': 330.0}, True),
    ({'k1': -0.5, 'k2': 0.5}, False),  # they trade with the focal length
])
def test_a_contradiction_is_three_combined_sigmas(change, found):
    new = dataclasses.replace(TRUTH, **change)
    assert bool(contradicted(OLD.camera, OLD.sigma, new, SIGMA)) == found


@pytest.mark.parametrize('model', [Brown, Fisheye])
def test_the_same_lens_in_another_model_confirms(model):
    narrow = Radial((640, 360), 550.0, 551.0, 320.0, 180.0, -0.1, 0.02)
    other = as_model(narrow, model)
    old = NamedCamera('old', narrow, SIGMA, 'accepted')
    tiny = dict.fromkeys(other.names(), 1e-6)
    assert not contradicted(old.camera, old.sigma, other, tiny)
    assert contradicted(old.camera, old.sigma, dataclasses.replace(other, fx=other.fx + 10), tiny)
    new = dataclasses.replace(calibration(), camera=other, sigma=tiny)
    assert judge(new, True, old, 0, RULES).action == 'replace'
    assert judge(calibration(), True, NamedCamera('old', as_model(TRUTH, model), dict.fromkeys(
        other.names(), 2.0), 'accepted'), 0, RULES).action == 'keep'


def test_every_parameter_is_told_with_digits_enough():
    lens = Brown((640, 360), 400.0, 401.0, 320.0, 180.0, -0.3, 0.1, 0.00034, -0.00052, 0.01)
    sigma = dict.fromkeys(lens.names(), 0.00006) | {'fx': 2.0}
    text = sigma_text(NamedCamera('new', lens, sigma))
    assert text.startswith('fx 400.00 ± 2.00, ') and 'k1 -0.3000 ± ' in text
    assert 'p1 0.000340 ± 0.000060' in text and text.endswith('k3 0.010000 ± 0.000060')


def test_sigmas_too_good_to_be_true_do_not_contradict():
    tiny = dict.fromkeys(SIGMA, 1e-6)
    old = dataclasses.replace(OLD, sigma=tiny)
    assert not contradicted(old.camera, old.sigma, dataclasses.replace(TRUTH, fx=402.0), tiny)
