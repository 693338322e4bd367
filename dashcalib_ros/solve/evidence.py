# SPDX-License-Identifier: Apache-2.0
"""What is there, decided at the common optimum: the kind of lens, a picture that moves or is bent.

A kind of lens is judged by the turns that did not make it: each is left out in turn. At the
optimum the cost of every turn is a quadratic function of what turns share, so the solution without
a turn, and what it costs that turn, need no new adjustment.

A picture that shifts, zooms or is bent locally is judged by a few more parameters: what they gain
is compared with what chance would gain, each track counted as one measurement. The ratio is about
1 for a fixed camera. It is named where it is clear, and large enough to matter.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from operator import itemgetter
from typing import Literal

import numpy as np

from dashcalib_ros.arrays import Floats, Ints
from dashcalib_ros.camera import MODELS
from dashcalib_ros.camera.mapping import mapping_error
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.input.motion import Samples
from dashcalib_ros.problem.blocks import (
    Bend,
    Block,
    Drift,
    ImageBlock,
    Imaging,
    Shift,
    Warmth,
    Zoom,
)
from dashcalib_ros.problem.normal import COMMON_DRIFT, Normal, normal_equations
from dashcalib_ros.problem.quadratic import Quadratic
from dashcalib_ros.reconstruct.scene import errors_px
from dashcalib_ros.solve.optimise import (
    FIRST_TRACKS,
    TEST_LOSS,
    Estimate,
    costs_by_track,
    evidence,
)
from dashcalib_ros.solve.written import sees_as_pinhole

Kind = Literal['shift', 'zoom', 'bend']

# times what chance gains; more is clear
CLEAR: Mapping[Kind, float] = {'shift': 2.0, 'zoom': 2.0, 'bend': 8.0}
# times these behind a rolling shutter, of which bumps leave something over; and in one turn alone.
# Clips of 10 s of fixed cameras have up to 2.2 in one turn
ROLLING, ONE_TURN = 1.35, 1.5
# of the shift, where a stabiliser's crop was found: what is left of it
LEFT_SHIFT = 4.0
# what matters: of the width; of 1; px of 1000 px of width
MATTERS: Mapping[Kind, float] = {'shift': 0.004, 'zoom': 0.004, 'bend': 0.3}
# sigmas of a slow shift, of the width, among which the evidence chooses, and the nats it takes
SHIFT_SIZES, SHIFT_NATS = (0.0005, 0.001, 0.002, 0.004, 0.008, 0.016), 3.0
# nats that it takes in addition where the user says that there is no stabiliser: the logarithm of
# 100, as users are right 99 times of 100. Ten stretches of a highway from a fixed camera have 3.2
AGAINST_KNOWN_NATS = 4.6
# degrees of yaw: a stabiliser hides less in a stretch; more shows whether there is one
HIDDEN_DEG, SHARP_DEG = 20.0, 45.0
# sigmas of a drift of the focal length over a drive among which the evidence chooses, the first
# as good as none, and the nats it takes; minimum number of turns
STEADY, DRIFTS, DRIFT_NATS, LEAST_DRIFTING = 1e-6, (0.002, 0.005, 0.015, 0.05, 0.2), 4.0, 3
# K; a temperature that changes less says nothing: a lens grows by 0.02 % for each
LEAST_SPAN_K = 2.0
# nats by which one way of changing must be ahead of the others: twice as likely
RIVAL_NATS = 0.7
# noise variances of a track by which a kind of lens must predict turns better
LEAST_GAIN = 30.0
# the same of another kind, of its cost: fisheyes have 0.1 and more, windscreens up to 0.06; and
# px RMS of 1000 px of width, of which fisheyes have 0.026 and more. Where tracks are nearly exact,
# what a smooth field leaves of a windscreen, or what a step would still lower, is much of a cost
LEAST_KIND_GAIN, LEAST_KIND_PX = 0.08, 0.015


# px RMS of 1000 px of width: sound fisheyes leave 0.001 to 0.034, one of nine 0.22; a windscreen
# 0.88 and more, another kind of lens 2 to 4
SMALL_FIELD, LARGE_FIELD = 0.1, 1.0


# the kind of lens

@dataclass(frozen=True)
class Candidate:
    """A kind of lens that was tried.

    loses_by: how much worse than the chosen one it predicts the turns left out: the sum of the
    robust squared errors, in units of the noise of a track; 0 for the chosen one, negative for one
    that does better, but not clearly. apart_px: how far its camera is from the chosen one over the
    picture; None where they cannot be compared. chosen: it is the one that the turns choose.
    cost_ratio: its cost of the turns left out over that of the chosen one. field: RMS px of 1000
    px of width that it leaves to a windscreen. folds: it folds over in the picture, as no lens
    does.
    """

    model: str
    loses_by: float
    apart_px: float | None = None
    chosen: bool = False
    cost_ratio: float = 1.0
    field: float = 0.0
    folds: bool = False


def costs_of(now: Estimate, loss_px: float) -> list[Quadratic]:
    """Return each turn's cost about what turns share, at the noise; images' shifts follow."""
    unit = now.noise(loss_px).variance * now.inflation
    return [cost.at_noise(unit) for cost in costs_by_track(
        now.linear(loss_px), unit, COMMON_DRIFT * float(np.sqrt(unit)))]


def costs_left_out(now: Estimate, loss_px: float) -> dict[TurnId, float]:
    """Return what each turn costs with all that the other turns find, in units of the noise.

    loss_px: of the Cauchy loss. With one turn only, its cost with its own camera.
    """
    unit = now.noise(loss_px).variance * now.inflation
    turns = [normal_equations(each, unit).cost.at_noise(unit) for each in now.linear(loss_px)]
    total = Quadratic.together([*turns, now.imaging.prior()])
    limit_px, found = now.config.scene.error_px, {}
    for scene, turn in zip(now.seen_by_lens, turns, strict=True):
        errors = np.minimum(errors_px(scene, now.camera), limit_px)[scene.tracks.seen]
        found[scene.turn] = float(loss_px**2 * np.log1p(errors**2 / loss_px**2).sum()) / unit
        if len(turns) > 1:
            others = np.linalg.solve(total.hessian - turn.hessian, -turn.score)
            # near the optimum it cannot cost less without the turn; elsewhere this says nothing
            found[scene.turn] += max(turn.change(np.asarray(others)), 0.0)
    return found


def chosen_kind(found: Sequence[Estimate]) -> tuple[Estimate, tuple[Candidate, ...]]:
    """Return the estimate whose kind of lens predicts the turns best, and how others compare.

    A fisheye comes after the pinholes, and must be much better: a decentred pinhole is none. Where
    the pinhole folds over in the picture, which no real lens does, clearly better is enough.
    """
    if len(found) == 1:
        return found[0], ()
    families = list(dict.fromkeys(model.family for model in MODELS.values()))
    found = sorted(found, key=lambda each: families.index(each.camera.family))
    loss_px = min(each.loss_px() for each in found)
    costs = [costs_left_out(each, loss_px) for each in found]
    # in the same units; a turn that a camera does not explain at all counts against it
    unit = [each.noise(loss_px).variance * each.inflation
            for each in found]
    least = min(unit)
    costs = [{turn: cost * own / least for turn, cost in each.items()}
             for each, own in zip(costs, unit, strict=True)]
    worst = {turn: max(each.get(turn, 0.0) for each in costs) for each in costs for turn in each}
    totals = [{turn: each.get(turn, 2 * worst[turn]) for turn in worst} for each in costs]
    best = 0
    for n in range(1, len(found)):
        gains = np.array([totals[best][turn] - totals[n][turn] for turn in worst])
        alike = found[n].camera.family == found[best].camera.family
        # no real lens folds over: where the pinholes need that, a fisheye need not be as good
        mends = found[n].camera.covers_picture() and not found[best].camera.covers_picture()
        if is_clear(gains) and (alike or mends or is_clear(
                gains, _least_of_another(found[n], sum(totals[n].values()), least))):
            best = n
    sums = [sum(each.values()) for each in totals]
    chosen = found[best]
    return chosen, tuple(Candidate(
        each.camera.model, sums[n] - sums[best], mapping_error(each.camera, chosen.camera),
        n == best, sums[n] / sums[best], field_size(each), not each.camera.covers_picture())
        for n, each in enumerate(found))


def field_size(found: Estimate) -> float:
    """Return the size of the residual distortion, RMS px of 1000 px of width."""
    size = np.sqrt(np.mean(found.imaging.field.over(found.camera)**2))
    return float(size * 1000 / found.camera.image_size[0])


def _least_of_another(found: Estimate, cost: float, unit: float) -> float:
    """Return the gain, in units (px^2) of the noise, that another kind of lens must have.

    Infinite where a pinhole sees the picture as this one does: then its kind cannot be the reason.
    """
    if sees_as_pinhole(found.camera):
        return np.inf
    px = LEAST_KIND_PX * found.camera.image_size[0] / 1000
    observations = sum(int(scene.tracks.seen.sum()) for scene in found.scenes)
    return max(LEAST_KIND_GAIN * cost, px**2 * observations / unit)


def is_clear(gains: Floats, least: float = LEAST_GAIN) -> bool:
    """Return whether the gains (n,) of turns, in noise variances of a track, are clear evidence.

    They must be larger in sum than least, and not come from one turn.
    """
    several = len(gains) < 2 or (np.sum(np.sort(gains)[:-1]) > 0
                                 and np.sum(gains > 0) > len(gains) / 2)
    return bool(gains.sum() > least and several)


# a fixed picture

@dataclass(frozen=True)
class FixedCameraTest:
    """Whether the camera is fixed, or its picture moves in one way.

    strength: what the parameters of this kind gain, over what chance would gain; more than limit
    is evidence. size: the root mean square of the shift or the bend, px, or of the zoom; least:
    the smallest that matters. by_turn: the mean zoom of each turn; empty for other kinds.
    """

    kind: Kind
    strength: float
    limit: float
    size: float
    least: float
    by_turn: Mapping[TurnId, float]

    @property
    def clear(self) -> bool:
        """Return whether chance does not explain it, and it matters; so for NaN."""
        return not (self.strength <= self.limit or self.size <= self.least)


@dataclass(frozen=True)
class _Step:
    """A step with more parameters than those of what turns share.

    gain: by how much it lowers the cost, at unit noise; chance: how much noise alone would, each
    track counted as one measurement. shared: (s,); images: (p,) of each turn's free ones.
    """

    gain: float
    chance: float
    shared: Floats
    images: tuple[Floats, ...]

    def strength(self, base: _Step) -> float:
        """Return what this step gains over one without its parameters, over what chance would."""
        return (self.gain - base.gain) / max(self.chance - base.chance, 1e-9)


def fixed_camera_tests(found: Estimate) -> tuple[FixedCameraTest, ...]:
    """Return the tests whether the camera is a fixed one, the clearest that it is not first.

    With a part of the tracks.
    """
    now = found.still.with_tracks(FIRST_TRACKS)
    loss_px, width = TEST_LOSS * now.loss_px(), now.camera.image_size[0]
    variance, count = now.noise(loss_px).variance, len(now.imaging.names)
    shift, zoom = now.imaging.blocks.get(Shift.name, Shift()), Zoom()
    asked = now.having(shift, zoom, Bend())
    normals = [normal_equations(each, variance * now.inflation, (shift.name, zoom.name),
                                tracks=True) for each in asked.linear(loss_px)]
    prior, own = asked.imaging.prior(), np.arange(count)

    def solved(block: Block | None, places: Ints) -> _Step:
        return _solved(normals, prior, variance, block, places)

    def test(kind: Kind, step: _Step, base: _Step, limit: float, unit: float) -> FixedCameraTest:
        parts = step.images if kind != 'bend' else (step.shared[len(own):],)
        turns = {scene.turn: float(part.mean())
                 for scene, part in zip(now.scenes, parts, strict=False)}
        return FixedCameraTest(
            kind, step.strength(base), limit,
            float(np.sqrt(np.mean(np.square(np.concatenate(parts))))), MATTERS[kind] * unit,
            turns if kind == 'zoom' else {})

    fixed, more = solved(None, own), ONE_TURN if len(now.scenes) == 1 else 1.0
    if now.imaging.coupled:
        more *= ROLLING
    # a stabilised picture goes on moving
    moving = shift if now.moves else None
    tests = [test('shift', solved(shift, own), fixed,
                  LEFT_SHIFT if now.moves else more * CLEAR['shift'], width),
             test('zoom', solved(zoom, own), fixed, more * CLEAR['zoom'], 1.0),
             test('bend', solved(moving, np.arange(len(prior.score))), solved(moving, own),
                  CLEAR['bend'], width / 1000)]
    return tuple(sorted(tests, key=lambda each: (not each.clear, -each.strength / each.limit)))


def _solved(normals: Sequence[Normal], prior: Quadratic, variance: float,
            block: Block | None, places: Ints) -> _Step:
    """Return the step with these shared parameters free, and a block of images; None: none."""
    gain = chance = 0.0
    costs, wholes = [prior.of(places)], []
    for normal in normals:
        cost, count = _with_images(normal, prior, variance, block, places)
        own = cost.of(np.arange(count))
        gain += float(own.score @ own.optimum) / variance
        chance += own.chance / variance
        wholes.append((cost, count))
        costs.append(cost.eliminated(count).at_noise(variance))
    total = Quadratic.together(costs)
    step = total.optimum
    of_images = tuple(cost.moved(np.pad(step, (count, 0))).of(np.arange(count)).optimum
                      for cost, count in wholes if count)
    return _Step(gain + float(total.score @ step), chance + total.chance, step, of_images)


def _with_images(normal: Normal, prior: Quadratic, variance: float, block: Block | None,
                 places: Ints) -> tuple[Quadratic, int]:
    """Return a turn's cost about a block's values of its images, with their prior, and the rest.

    places: of what turns share. Also how many values there are; 0 where the block has none.
    """
    first = len(normal.cost.score) - len(prior.score)
    if not isinstance(block, ImageBlock):
        return normal.cost.of(first + places), 0
    free = np.arange(first)[normal.places[block.name]]
    precision, off = block.prior_of(normal.linear.stretch)
    return Quadratic.together([
        normal.cost.of(np.concatenate([free, first + places])), Quadratic.prior(
            variance * precision, np.zeros(len(places)),
            -variance * np.pad(precision @ off, (0, len(places))))]), len(free)


def shift_size(found: Estimate) -> float:
    """Return the sigma of a slow shift of the images that the evidence favours, of the width.

    0 where a fixed picture is as likely, or is known. The evidence is the marginal likelihood: the
    shifts, and what turns share, are at their optimum.
    """
    now = found.with_tracks(FIRST_TRACKS)
    loss_px = now.loss_px()
    unit = now.noise(loss_px).variance * now.inflation
    normals = [normal_equations(each, unit, (Shift.name,))
               for each in now.having(Shift()).linear(loss_px)]
    prior = now.imaging.prior()

    def nats(block: Shift | None) -> float:
        logs, costs = 0.0, [prior]
        for normal in normals:
            cost, count = _with_images(normal, prior, unit, block, np.arange(len(prior.score)))
            if block is not None:
                own = cost.of(np.arange(count))
                precision, _ = block.prior_of(normal.linear.stretch)
                logs += (float(own.score @ own.optimum) / unit
                         - float(np.linalg.slogdet(own.hessian / unit)[1])
                         + float(np.linalg.slogdet(precision)[1]))
            costs.append(cost.eliminated(count).at_noise(unit))
        total = Quadratic.together(costs)
        return 0.5 * (logs + float(total.score @ total.optimum)
                      - float(np.linalg.slogdet(total.hessian)[1]))

    by_size = {size: nats(Shift(sigma=size)) for size in SHIFT_SIZES}
    best = max(SHIFT_SIZES, key=by_size.__getitem__)
    least = SHIFT_NATS + AGAINST_KNOWN_NATS * (found.config.known.stabiliser == 'no')
    return best if by_size[best] - nats(None) > least else 0.0


def drifting(found: Estimate, temperature: Samples | None = None) -> tuple[Drift | None, float]:
    """Return how the focal length changes, as the evidence favours it; None for a steady one.

    It grows steadily, or steps between two turns; or it does all of that, as a zoom, and where the
    turns do not tell which. Two turns cannot. temperature: that it goes with in the place of
    time, unless that explains it clearly better.

    And the RMS change over the turns, of fx, that the evidence does not exclude where it is None:
    a mean over a steady lens and all ways and sizes. Each turn counts by what it knows about fx:
    one that knows little does not decide.
    """
    own_ns = [scene.tracks.stamps_ns for scene in found.scenes if scene.turn.of_this_drive]
    turns = sorted((int(stamps.min()), int(stamps.max())) for stamps in own_ns)
    if len(turns) < LEAST_DRIFTING:
        return None, 0.0
    begins, ends = [begin for begin, _ in turns], [*accumulate((end for _, end in turns), max)]
    # where turns overlap nothing steps between them
    steps = tuple((end + begin) // 2 for end, begin in zip(ends, begins[1:], strict=False)
                  if end < begin)
    warmth = Warmth.over(temperature, own_ns)
    if warmth is not None and warmth.span_k < LEAST_SPAN_K:
        warmth = None
    asked = Drift(np.zeros(1 + (warmth is not None) + len(steps)), begins[0], ends[-1], STEADY,
                  warmth=warmth, steps_ns=steps)
    now = found.with_tracks(FIRST_TRACKS).having(asked)
    loss_px = now.loss_px()
    unit = now.noise(loss_px).variance * now.inflation
    costs = [normal_equations(each, unit).cost.at_noise(unit) for each in now.linear(loss_px)]
    total = Quadratic.together(costs)
    places = np.arange(len(total.score))
    own = places[now.imaging.places[Drift.name]]

    middles_ns = np.array([stamps.mean() for stamps in own_ns]).astype(np.int64)
    steady, known = np.setdiff1d(places, own), now.imaging.prior()
    weights = np.array([
        1 / Quadratic.together([cost.of(steady), known.of(steady)]).covariance[0, 0]
        for cost, scene in zip(costs, now.scenes, strict=True) if scene.turn.of_this_drive])
    unnamed: list[tuple[float, float]] = []

    def likeliest_of(ways: Drift, kept: Ints) -> tuple[float, Drift]:
        """Return the nats over a steady focal length, and the block of the likeliest size."""
        cost = total.of(np.setdiff1d(places, np.setdiff1d(own, kept)))
        sized = [replace(ways, sigma=size) for size in (STEADY, *DRIFTS)]
        none, *nats = (evidence(cost, now.imaging.having(each), each) for each in sized)
        if ways.size == 1:
            spread = float(np.cov(ways.grown_at(middles_ns)[:, 0], aweights=weights, ddof=0))
            unnamed.extend((more - none, spread * _mean_square(cost, now.imaging.having(each)))
                           for more, each in zip(nats, sized[1:], strict=True))
        return max(nats) - none, sized[1 + int(np.argmax(nats))]

    one, kept = replace(asked, value=np.zeros(1), warmth=None), own
    alone = [likeliest_of(replace(one, steps_ns=()), own[:1])]
    if warmth is not None:
        warm = likeliest_of(replace(one, steady=False, warmth=warmth, steps_ns=()), own[1:2])
        follows = warm[0] > max(DRIFT_NATS, alone[0][0] - DRIFT_NATS)
        alone, kept = ([warm], own[1:]) if follows else (alone, np.delete(own, 1))
        asked = replace(asked, value=np.zeros(len(kept)), steady=not follows,
                        warmth=warmth if follows else None)
    for place, step_ns in zip(kept[1:], steps, strict=True):
        nats, step = likeliest_of(replace(one, steady=False, steps_ns=(step_ns,)), place)
        # any of the steps is as likely as a steady growth
        alone.append((nats - float(np.log(len(steps))), step))
    (best, way), *others = sorted(alone, key=itemgetter(0), reverse=True)
    if best <= DRIFT_NATS:
        nats, squares = np.array(unnamed).T
        likely = np.exp(nats) / len(nats)
        return None, float(np.sqrt(likely @ squares / (1 + likely.sum())))
    # where another way is nearly as likely, the sigma of all of them contains it
    every, ways = likeliest_of(asked, kept)
    rival = max((nats for nats, _ in others), default=-np.inf)
    return ways if every > best + DRIFT_NATS or rival > best - RIVAL_NATS else way, 0.0


def _mean_square(cost: Quadratic, imaging: Imaging) -> float:
    """Return the mean square of a drift of one way, given the turns."""
    known, place = Quadratic.together([cost, imaging.prior()]), imaging.places[Drift.name].start
    return float(known.optimum[place]**2 + known.covariance[place, place])


def moves(tests: Sequence[FixedCameraTest]) -> bool:
    """Return whether a stabiliser may have shifted the pictures: that looks like a zoom, too."""
    shift = next(test for test in tests if test.kind == 'shift')
    return shift.strength > CLEAR['shift'] and any(
        test.clear for test in tests if test.kind != 'bend')


def largest_crop(crops: Mapping[TurnId, Floats]) -> float:
    """Return the largest distance of the crop from its middle, px."""
    paths = np.concatenate(list(crops.values()))
    return float(np.abs(paths - np.median(paths, axis=0)).max())
