# SPDX-License-Identifier: Apache-2.0
"""What units of one model have in common: a normal distribution of their lenses, from the fleet.

The units of a camera model have nearly the same focal length and
distortion (the centre is each unit's own). Each unit is measured with its own covariance S;
between units the lenses differ by a covariance B, which is estimated by maximum likelihood (EM),
so that S is not mistaken for B. The spreads below count as some more units. A unit with one turn
has no scatter between turns in its S: by how much such S are too small is estimated, too. A unit
that is several sigmas off is in another mode of its sensor: it is thrown out, and has no prior.
Nor has a unit that knows so little that it may well be in another mode. A unit's prior is made
without itself.

Focal lengths are compared by their curvature, -(w/f)^2 / 2. What a bend of the road shows beyond a
shift of the picture is proportional to the square of x/f, so that this is what a bend measures
with an error that does not depend on f. In f itself, or its logarithm, a unit whose error is
negative would claim a smaller sigma, and the mean of many such units would be too small.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from dashcalib_ros.arrays import Floats, Mask
from dashcalib_ros.camera import Camera
from dashcalib_ros.config import FleetConfig
from dashcalib_ros.input.source import size_text

# sigmas; a camera farther from the fx of its model uses another mode of the sensor
OTHER_MODE = 3.0


@dataclass(frozen=True)
class Unit:
    """A camera's own estimate. camera_model: with all that its units share, such as the size.

    lens: (d,) the curvature of the focal length, then the distortion coefficients.
    covariance: (d, d). one_turn: it is made from one turn only.
    """

    name: str
    camera_model: tuple[str, ...]
    lens: Floats
    covariance: Floats
    one_turn: bool = False


@dataclass(frozen=True)
class LensPrior:
    """Of one unit: mean (d,), covariance (d, d). units: how many others it is made from.

    excess: by how much the variances of units with one turn are too small, 1 or more.
    """

    mean: Floats
    covariance: Floats
    units: int
    excess: float = 1.0

    def excess_of(self, unit: Unit) -> float:
        """Return by how much a unit's own variances are too small."""
        return self.excess if unit.one_turn else 1.0


@dataclass(frozen=True)
class ModelPrior:
    """A unit's prior; None with the reason, which may be that it is in another mode."""

    prior: LensPrior | None
    why_not: str = ''
    other_mode: bool = False


# units that are left out together where there are many of them: one in so many changes nothing
FOLDS = 40


def priors(units: Sequence[Unit], config: FleetConfig) -> dict[str, ModelPrior]:
    """Return each unit's prior, from the other units of its camera model."""
    found: dict[str, ModelPrior] = {}
    ordered = sorted(units, key=lambda unit: (unit.camera_model, unit.name))
    for _, group in groupby(ordered, key=lambda unit: unit.camera_model):
        of_make = list(group)
        folds = min(len(of_make), FOLDS)
        for fold in range(folds):
            others = [unit for n, unit in enumerate(of_make) if n % folds != fold]
            prior = lens_prior(others, config)
            for unit in of_make[fold::folds]:
                found[unit.name] = _of_make(unit, prior, len(others), config)
    return found


def curvature(focal: Floats) -> Floats:
    """Return the curvature of focal lengths over the width."""
    return np.asarray(-0.5 / np.square(focal))


def focal_length(curvature: Floats) -> Floats:
    """Return the focal lengths over the width that have these curvatures, all negative."""
    return np.asarray(1 / np.sqrt(-2 * np.asarray(curvature)))


# that a unit is in the mode of its camera model, by its own turns; with less: no prior
LEAST_ODDS = 3.0


def _of_make(unit: Unit, prior: LensPrior | None, others: int, config: FleetConfig) -> ModelPrior:
    if prior is None:
        return ModelPrior(None, f'its model has {others} other usable cameras; a prior needs '
                            f'{config.least_units} that agree')
    if off_by(unit, prior) > OTHER_MODE:
        percent = 100 * (focal_length(unit.lens[0]) / focal_length(prior.mean[0]) - 1)
        return ModelPrior(None, f'its fx differs by {percent:+.1f} % from the prior of its '
                                f'model, or '
                            f'its distortion differs: another mode of the sensor, or another '
                            f'device', True)
    if odds_of_mode(unit, prior) < LEAST_ODDS:
        return ModelPrior(None, 'its own turns cannot show whether its sensor is in the usual '
                                'mode of its model')
    return ModelPrior(prior)


def odds_of_mode(unit: Unit, prior: LensPrior) -> float:
    """Return how much likelier a focal length is in the mode of its camera model than in another.

    Another mode may have any focal length from half to twice that of the camera model.
    """
    # of the logarithm of the focal length
    slope = -2 * prior.mean[0]
    variance = (prior.excess_of(unit) * unit.covariance[0, 0] + prior.covariance[0, 0]) / slope**2
    off = (unit.lens[0] - prior.mean[0]) / slope
    density = np.exp(-off**2 / variance / 2) / np.sqrt(2 * np.pi * variance)
    return float(density * 2 * np.log(2))


def off_by(unit: Unit, prior: LensPrior) -> float:
    """Return by how many sigmas a unit is off a prior, where it is off most."""
    variance = np.diag(prior.excess_of(unit) * unit.covariance + prior.covariance)
    return float(np.max(np.abs(unit.lens - prior.mean) / np.sqrt(variance)))


# steps of EM, and how often units are thrown out and taken back
STEPS, ROUNDS = 200, 10


def lens_prior(units: Sequence[Unit], config: FleetConfig) -> LensPrior | None:
    """Return the distribution of the lenses of those units that agree; None if they are few."""
    if len(units) < config.least_units:
        return None
    focal = np.array([unit.lens[0] for unit in units])
    agree = _densest(focal, np.array([unit.covariance[0, 0] for unit in units]))
    prior = _fitted([unit for unit, kept in zip(units, agree, strict=True) if kept])
    for _ in range(ROUNDS):
        now = np.array([off_by(unit, prior) <= OTHER_MODE for unit in units])
        if now.sum() < config.least_units:
            return None
        if np.array_equal(now, agree):
            break
        agree = now
        prior = _fitted([unit for unit, kept in zip(units, agree, strict=True) if kept])
    return prior


# candidates for the middle of the units
CANDIDATES = 500
# of fx between units of a model; 14 models in public profiles: 1 to 1.5 %
FOCAL_SPREAD = 0.0125


def _densest(focal: Floats, variance: Floats) -> Mask:
    """Return (n,) the units around the value that most others agree with: the main mode.

    focal: (n,) curvatures; variance: (n,) of each. A unit that knows little counts little.
    """
    spread = np.square(2 * focal * FOCAL_SPREAD)
    total = variance + spread
    weight = spread / total
    # the candidates are the best known units
    best = np.argsort(-weight, kind='stable')[:CANDIDATES]
    near = np.abs(focal[best, None] - focal) < OTHER_MODE / 2 * np.sqrt(total)
    middle = focal[best[int(np.argmax(near @ weight))]]
    return np.asarray(np.abs(focal - middle) < OTHER_MODE * np.sqrt(total))


# of the change of B; EM has ended
SETTLED = 1e-6
# of the variance of units with one turn: real turns are off by 2 to 8 times the sigma of noise
MOST_EXCESS = 64.0
# of k1 and the like between units of a model: much less than of fx
DISTORTION_SPREAD = 0.01
# units that the two spreads count as, beside those of the fleet
SPREAD_UNITS = 20.0
# by which one turn varies more than its noise, counts so, too
ONE_TURN_EXCESS = 3.0


def _fitted(units: Sequence[Unit]) -> LensPrior:
    lenses = np.array([unit.lens for unit in units])
    own = np.array([unit.covariance for unit in units])
    vague = np.array([unit.one_turn for unit in units])
    count, size = lenses.shape
    focal_spread = 2 * float(np.median(lenses[:, 0])) * FOCAL_SPREAD
    assumed = np.diag([focal_spread**2] + [DISTORTION_SPREAD**2] * (size - 1))
    between, excess = assumed, ONE_TURN_EXCESS if vague.any() else 1.0
    for _ in range(STEPS):
        noise = own * np.where(vague, excess, 1.0)[:, None, None]
        weights = np.linalg.inv(between + noise)
        of_mean = np.linalg.inv(weights.sum(axis=0))
        mean = of_mean @ np.einsum('nij,nj->i', weights, lenses)
        gain = between @ weights
        offset = np.einsum('nij,nj->ni', gain, lenses - mean)
        # what a unit's own data, and the mean, leave unknown of its offset
        rest = between - gain @ between + gain @ of_mean @ gain.transpose(0, 2, 1)
        total = offset.T @ offset + rest.sum(axis=0) + SPREAD_UNITS * assumed
        new = total / (count + SPREAD_UNITS)
        change = np.max(np.abs(new - between)) / np.max(np.diag(new))
        between = (new + new.T) / 2
        if vague.any():
            # of fx: its sigma is what matters
            error = (lenses - mean - offset)[:, 0]
            ratios = (error**2 + rest[:, 0, 0]) / own[:, 0, 0]
            known = ratios[vague].sum() + SPREAD_UNITS * ONE_TURN_EXCESS
            now = min(max(float(known / (vague.sum() + SPREAD_UNITS)), 1.0), MOST_EXCESS)
            change, excess = max(change, abs(now - excess)), now
        if change < SETTLED:
            break
    return LensPrior(mean, between + of_mean, count, excess)


def unit_of(name: str, camera_model: str, camera: Camera, covariance: Floats, one_turn: bool
            ) -> Unit:
    """Return what a camera, with its covariance (n, n), adds to the prior of its camera model."""
    values, slopes = _in_curvatures(camera)
    which = _lens_places(len(values))
    spread = (covariance * np.outer(slopes, slopes))[np.ix_(which, which)]
    return Unit(name, (camera_model, size_text(camera.image_size), camera.model), values[which],
                spread, one_turn)


def conditioned(camera: Camera, covariance: Floats, prior: LensPrior) -> tuple[Camera, Floats]:
    """Return the camera and its covariance (n, n) after the prior.

    Estimate and prior are normal distributions, the estimate linearised at the unit's own
    solution: one step of conditioning.
    """
    values, slopes = _in_curvatures(camera)
    spread = covariance * np.outer(slopes, slopes)
    which = _lens_places(len(values))
    gain = spread[:, which] @ np.linalg.inv(spread[np.ix_(which, which)] + prior.covariance)
    values = values + gain @ (prior.mean - values[which])
    keep = np.eye(len(values))
    keep[:, which] -= gain
    # Joseph's form stays positive
    spread = keep @ spread @ keep.T + gain @ prior.covariance @ gain.T
    params = values * _scales(camera)
    params[:2] = focal_length(values[:2]) * camera.image_size[0]
    moved = camera.with_params(params)
    _, back = _in_curvatures(moved)
    return moved, spread / np.outer(back, back)


def _in_curvatures(camera: Camera) -> tuple[Floats, Floats]:
    """Return (n,) the curvatures, cx/w, cy/w and the coefficients, and (n,) their derivatives.

    Each is that by the camera's own parameter.
    """
    values, slopes = camera.params / _scales(camera), 1 / _scales(camera)
    values[:2] = curvature(values[:2])
    slopes[:2] = camera.image_size[0]**2 / camera.params[:2]**3
    return values, slopes


def _scales(camera: Camera) -> Floats:
    return np.where(np.arange(len(camera.params)) < 4, float(camera.image_size[0]), 1.0)


def _lens_places(count: int) -> list[int]:
    return [0, *range(4, count)]
