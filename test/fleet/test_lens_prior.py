# SPDX-License-Identifier: Apache-2.0
"""The prior of a camera model: from units that know little, it learns what they share."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dashcalib_ros.camera import Radial
from dashcalib_ros.config import FleetConfig
from dashcalib_ros.errors import Notice
from dashcalib_ros.fleet.lens_prior import (
    LensPrior,
    ModelPrior,
    Unit,
    conditioned,
    curvature,
    focal_length,
    lens_prior,
    priors,
)
from dashcalib_ros.fleet.solved import ClipShare, Estimate, Solved, final_of, unit_of
from dashcalib_ros.judge import Verdict
from dashcalib_ros.report import Calibration
from dashcalib_ros.solve.spread import PictureSigma

CONFIG = FleetConfig()
MEAN = np.array([curvature(0.65), -0.28, 0.09])
# of the curvature by the logarithm of the focal length
SLOPE = 0.65**-2
SPREAD = np.diag([0.01 * SLOPE, 0.003, 0.003])**2


def fleet(seed, count=30, sigma=0.03, zooms=(), excess=1.0):
    """Return units of one camera model, and the truth of each; each knows fx to its own sigma."""
    rng = np.random.default_rng(seed)
    units, truths = [], []
    for n in range(count + len(zooms)):
        truth = rng.multivariate_normal(MEAN, SPREAD)
        if n >= count:
            truth[0] /= zooms[n - count]**2
        own = np.diag([sigma * SLOPE * rng.uniform(0.7, 1.4), 0.008, 0.01])**2
        # fx and k1 go together
        own[0, 1] = own[1, 0] = 0.6 * np.sqrt(own[0, 0] * own[1, 1])
        measured = rng.multivariate_normal(truth, excess * own)
        units.append(Unit(f'u{n:03}', ('acme', '800x450', 'radial'), measured, own, excess > 1))
        truths.append(truth)
    return units, np.array(truths)


def posterior(unit, prior):
    own = prior.excess_of(unit) * unit.covariance
    gain = own @ np.linalg.inv(own + prior.covariance)
    return (unit.lens + gain @ (prior.mean - unit.lens))[0], np.sqrt((own - gain @ own)[0, 0])


@pytest.mark.thorough
@pytest.mark.parametrize('excess', [1.0, 4.0])
def test_errors_are_halved_and_sigmas_hold(excess):
    errors, alone, inside = [], [], []
    for seed in range(12):
        units, truths = fleet(seed, excess=excess)
        found = priors(units, CONFIG)
        for unit, truth in zip(units, truths, strict=True):
            alone.append(abs(unit.lens[0] - truth[0]))
            errors.append(alone[-1])  # of a unit that knows too little for a prior
            if found[unit.name].prior is not None:
                value, sigma = posterior(unit, found[unit.name].prior)
                errors[-1] = abs(value - truth[0])
                inside.append(errors[-1] < 2 * sigma)
    assert len(inside) > 0.8 * 12 * 30
    assert np.median(errors) < 0.5 * np.median(alone)
    assert 0.94 < np.mean(inside) < 0.995


def test_units_in_another_mode_are_thrown_out_and_change_nothing():
    for seed in range(6):
        units, _ = fleet(seed, zooms=(1.4, 1.4, 1.4, 0.7, 1.25))
        found = priors(units, CONFIG)
        assert all(found[unit.name].other_mode for unit in units[30:])
        assert 'another mode' in found['u030'].why_not
        with_them, without = lens_prior(units, CONFIG), lens_prior(units[:30], CONFIG)
        assert with_them.mean == pytest.approx(without.mean, abs=0.003 * SLOPE)
        assert with_them.units <= 30


def test_a_unit_that_knows_too_little_to_tell_its_mode_has_no_prior():
    units, _ = fleet(7)
    vague = replace(units[0], covariance=units[0].covariance * np.diag([100.0, 1.0, 1.0]))
    found = priors([vague, *units[1:]], CONFIG)
    assert found['u000'].prior is None and not found['u000'].other_mode
    assert 'mode' in found['u000'].why_not


def test_errors_that_a_bend_makes_do_not_bias_the_mean():
    """A focal length that comes out too short claims a smaller sigma of its logarithm."""
    means = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        units, _ = fleet(seed, 40, sigma=0.04)
        focal = focal_length(MEAN[0] + 0.04 * SLOPE * rng.standard_normal(40))
        # as a unit tells it: sigma of f at its own f
        units = [replace(unit, lens=np.array([curvature(own), *MEAN[1:]]), covariance=np.diag(
            [0.04 * SLOPE, 0.008, 0.01])**2) for unit, own in zip(units, focal, strict=True)]
        means.append(focal_length(lens_prior(units, CONFIG).mean[0]) / 0.65 - 1)
    assert abs(np.mean(means)) < 2.5 * 0.04 / np.sqrt(20 * 40)


def test_the_larger_mode_wins_whatever_the_order():
    units, _ = fleet(1, 20, 0.01, zooms=[1.3] * 12)
    for order in (units, units[::-1]):
        assert focal_length(lens_prior(order, CONFIG).mean[0]) == pytest.approx(0.65, rel=0.02)
    one, two = priors(units, CONFIG), priors(units[::-1], CONFIG)
    assert all(np.array_equal(one[name].prior.mean, two[name].prior.mean)
               for name in one if one[name].prior)


def test_the_spread_between_units_is_not_their_noise():
    wide, _ = fleet(3, 200, 0.03)
    assert np.sqrt(lens_prior(wide, CONFIG).covariance[0, 0]) < 0.016 * SLOPE
    exact, _ = fleet(3, 200, 0.001)
    assert np.sqrt(lens_prior(exact, CONFIG).covariance[0, 0]) == pytest.approx(
        0.01 * SLOPE, rel=0.15)


def test_a_units_own_data_are_not_used_twice():
    units, _ = fleet(4, 12)
    moved = [replace(units[0], lens=units[0].lens + [0.02 * SLOPE, 0.0, 0.0]), *units[1:]]
    before, after = (priors(each, CONFIG) for each in (units, moved))
    np.testing.assert_array_equal(before['u000'].prior.mean, after['u000'].prior.mean)
    others = [name for name in before if before[name].prior and after[name].prior]
    assert len(others) > 6 and not any(np.array_equal(
        before[name].prior.mean, after[name].prior.mean) for name in others if name != 'u000')


def test_few_units_give_no_prior():
    units, _ = fleet(5, CONFIG.least_units)
    assert f'needs {CONFIG.least_units}' in priors(units, CONFIG)['u000'].why_not
    other = [replace(unit, camera_model=('other', '800x450', 'radial')) for unit in units]
    assert all(each.prior is None for each in priors([*units[1:], *other[:1]], CONFIG).values())


def solved_unit(level='weak', camera_model='acme', sigma=15.0, sound=True):
    camera = Radial((800, 450), 540.0, 541.0, 400.0, 220.0, -0.27, 0.08)
    covariance = np.diag([sigma, sigma, 2.0, 2.0, 0.01, 0.02])**2
    covariance[0, 1] = covariance[1, 0] = 0.99 * sigma**2
    calibration = Calibration(
        Verdict(level, () if level == 'accepted' else (Notice('', 'too little yaw'),)), (800, 450),
        None if level == 'refused' else camera, None, (), 100, 0.2, {}, {}, _config())
    return Solved('cam', camera_model, calibration,
                  Estimate(camera, 4 * covariance, covariance, PictureSigma(9.0, 20.0), 0.2,
                           sound),
                  {'a': ClipShare(1)})


def _config():
    from dashcalib_ros.config import Config
    return Config()


PRIOR = LensPrior(np.array([curvature(520 / 800), -0.28, 0.09]),
                  np.diag([0.01 * SLOPE, 0.005, 0.01])**2, 20)


@pytest.mark.parametrize('level', ['weak', 'refused'])
def test_a_prior_decides_and_the_verdict_says_so(level):
    final = final_of(solved_unit(level), ModelPrior(PRIOR))
    found = final.calibration
    assert found.verdict.level == 'weak'
    assert 'acme (20 other cameras)' in str(found.verdict.reasons[0])
    assert found.verdict.codes[0] == 'E-PRIOR-USED'
    assert f'{100 * final.prior_share:.0f} %' in str(found.verdict.reasons[0])
    assert str(found.verdict.reasons[1]).endswith(': too little yaw')
    assert 0.5 < final.prior_share < 1 and final.prior_units == 20
    assert 520 < found.camera.fx < 530 and found.camera.cx == 400.0
    # fy goes with fx, as the unit's own turns say
    assert abs(found.camera.fy - found.camera.fx) < 4
    alone = found.details['prior']
    assert found.sigma['fx'] < 6 < alone['sigma_alone']['fx'] and found.sigma_px.rms < 9
    assert alone['fx_alone'] == 540.0


def test_an_accepted_camera_stays_accepted_and_hardly_moves():
    final = final_of(solved_unit('accepted', sigma=1.0), ModelPrior(PRIOR))
    assert final.calibration.verdict.level == 'accepted' and final.prior_share < 0.1
    assert abs(final.calibration.camera.fx - 540) < 1


def test_where_there_is_no_prior_it_says_why():
    assert unit_of(solved_unit(camera_model='')) is None
    assert unit_of(solved_unit(sound=False)) is None
    assert 'unknown' in final_of(solved_unit(camera_model=''), None).prior_note
    thrown = final_of(solved_unit(), ModelPrior(None, 'its fx is off: another mode', True))
    assert thrown.other_mode and thrown.calibration.warnings[0].code == 'E-PRIOR-OTHER-MODE'
    assert thrown.calibration.camera.fx == 540.0


def test_conditioning_agrees_with_the_sum_of_informations():
    camera = Radial((800, 450), 522.0, 523.0, 400.0, 220.0, -0.279, 0.089)
    rng = np.random.default_rng(0)
    root = rng.standard_normal((6, 6)) * np.array([[1.0], [1.0], [0.5], [0.5], [1e-3], [1e-3]])
    covariance = root @ root.T
    moved, after = conditioned(camera, covariance, PRIOR)
    slope = np.zeros((3, 6))
    slope[0, 0], slope[1, 4], slope[2, 5] = 800**2 / camera.fx**3, 1, 1
    expected = np.linalg.inv(np.linalg.inv(covariance)
                             + slope.T @ np.linalg.inv(PRIOR.covariance) @ slope)
    step = expected @ slope.T @ np.linalg.inv(PRIOR.covariance) @ (
        PRIOR.mean - [curvature(camera.fx / 800), camera.k1, camera.k2])
    np.testing.assert_allclose(moved.params, camera.params + step, rtol=1e-3)
    np.testing.assert_allclose(after, expected, rtol=0.02, atol=1e-6)
