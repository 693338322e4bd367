# SPDX-License-Identifier: Apache-2.0
"""When a calibration is adopted, kept, replaced or given up: no ROS needed."""
from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from dashcalib_ros.camera import Brown, Fisheye, Radial
from dashcalib_ros.camera.mapping import as_model
from dashcalib_ros.config import Config
from dashcalib_ros.errors import Notice
from dashcalib_ros.judge import Verdict
from dashcalib_ros.judge.calibration import Drift
from dashcalib_ros.judge.difference import contradicted
from dashcalib_ros.judge.verdict import MOVES, STEADY
from dashcalib_ros.report import Calibration, NamedCamera
from dashcalib_ros.ros.settings import NodeConfig
from dashcalib_ros.ros.state import judge, sigma_text

RULES = NodeConfig(contradictions=3)
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


@pytest.mark.parametrize(('ratio', 'fx', 'action'), [
    (0.69, 400.0, 'follow'), (0.71, 400.0, 'keep'), (1.5, 400.0, 'keep'),
    (1.0, 401.9, 'keep'), (1.0, 402.1, 'follow'), (3.0, 406.0, 'keep'), (3.0, 411.0, 'follow')])
def test_a_confirming_one_is_followed_where_that_changes_something(ratio, fx, action):
    sigma = {**SIGMA, 'fx': ratio * SIGMA['fx']}
    judged = judge(calibration(sigma=sigma, fx=fx), True, OLD, 0, RULES)
    assert judged.action == action and judged.confirmed
    # too few turns to follow
    judged = judge(calibration(sigma=sigma, fx=fx), False, OLD, 0, RULES)
    assert judged.action == 'keep' and judged.confirmed


def test_the_share_of_each_is_what_it_knows_of_fx():
    sigma = {**SIGMA, 'fx': 1.0, 'k1': 0.02}
    found = judge(calibration(sigma=sigma, fx=402.0, k1=-0.25), True, OLD, 0, RULES).calibration
    assert found.camera.fx == pytest.approx(401.6) and found.camera.k1 == pytest.approx(-0.26)
    # between both, whatever they have in common
    assert found.sigma['fx']**2 == pytest.approx(0.2 * 4.0 + 0.8)
    assert found.sigma['k1']**2 == pytest.approx(0.2 * 1e-4 + 0.8 * 4e-4)
    assert found.covariance is None and found.picture_covariance is None
    # after a year the old one says little
    later = judge(calibration(fx=406.0), True, OLD, 0, RULES, 365.0).calibration
    assert later.camera.fx == pytest.approx(404.94, abs=0.01)
    assert judge(calibration(fx=412.0), True, OLD, 0, RULES).contradictions == 1
    for days in (365.0, 1e9):
        assert judge(calibration(fx=412.0), True, OLD, 0, RULES, days).action == 'follow'
        assert judge(calibration(fx=440.0), True, OLD, 0, RULES, days).contradictions == 1
    # a clock that was set back
    assert judge(calibration(fx=412.0), True, OLD, 0, RULES, -1e9).contradictions == 1


@pytest.mark.parametrize(('percent', 'spread'), [(0.0, 0.3), (0.5, 0.3), (0.5, 0.1), (1.0, 0.3)])
def test_a_lens_that_drifts_over_ten_drives_is_followed_and_not_contradicted(percent, spread):
    rng, against, right = np.random.default_rng(0), 0, []
    own = {**SIGMA, 'fx': spread * 4.0, 'fy': spread * 4.0}
    for _ in range(100):
        camera, count = dataclasses.replace(TRUTH, fx=400.0 + rng.normal(0, own['fx'])), 0
        published, days = NamedCamera('old', camera, own, 'accepted'), 0.0
        for drive in range(1, 11):
            days, truth = days + 1, 400.0 * (1 + percent / 1000 * drive)
            judged = judge(calibration(sigma=own, fx=truth + rng.normal(0, own['fx'])), True,
                           published, count, RULES, days)
            against, count = against + (not judged.confirmed), judged.contradictions
            if judged.calibration is not None:
                found, days = judged.calibration, 0.0
                published = NamedCamera('new', found.camera, found.sigma, 'accepted')
        right.append(abs(published.camera.fx - truth) < 2 * published.sigma['fx'])
    assert np.mean(right) >= 0.95 and against <= 4


def test_it_keeps_what_it_knows_of_the_temperature():
    drift = Drift(0.1, 0.05, 0.0, 0.05, 0.01, 20.0, 40.0)
    old = dataclasses.replace(OLD, drift=drift, temperature_c=30.0)
    warm = dataclasses.replace(calibration(fx=407.0), temperature_c=40.0)
    found = judge(warm, True, old, 0, RULES).calibration
    # 400 at 30 degrees is 402 at 40
    assert found.camera.fx == pytest.approx(404.5)
    assert (found.drift, found.temperature_c) == (drift, 40.0)
    found = judge(calibration(fx=405.0), True, old, 0, RULES).calibration
    assert (found.drift, found.temperature_c) == (drift, 30.0)


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
    assert judge(new, True, old, 0, RULES).action == 'follow'
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
