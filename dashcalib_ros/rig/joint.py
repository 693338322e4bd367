# SPDX-License-Identifier: Apache-2.0
"""Paths of several cameras -> one rig, as one least-squares problem.

All cameras sit on one car. Where a camera with rotation R, translation l (x' = R x + l, from the
base's axes) and a clock that is late by o has a pose in a scene of its own, the reference scene,
mostly the base's, says where it must be at that time:

    rotation = R P(t - o) G,    translation = (R (P(t - o) g + T(t - o)) + l / m) / s

P, T: the base's pose; m: metres in a unit of its scene; G, g, s: the similarity between both
scenes. The unknowns are each camera's rotation, translation and clock, m, and the similarities.
Each lens stays as its own turns say: the rotation that is written belongs to the lens that is
written. Poses follow their lens, so the covariance of the lenses is part of that of the places.

Beside the scenes' own noise there is what else no model has: at every keyframe, between two
keyframes of the reference, where the car shook, and slowly: the error of a direction of travel
lasts, that of a rotation adds up. Each is as large as the residuals say. So cameras with one
trigger gain, and a stretch counts less in which the car shakes.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import block_diag, solve_triangular

from dashcalib_ros.arrays import Floats, Ints
from dashcalib_ros.camera.rotation import rotation_matrices
from dashcalib_ros.judge.difference import distance
from dashcalib_ros.problem.trajectory import cross, logarithms
from dashcalib_ros.rig.paths import CameraPaths, ScenePath

# parameters of a camera: a small rotation in its own axes (rad), a translation (m), how late its
# clock is (s) and the pace of that; and those of a similarity
PLACE, GAUGE = 8, 7
# one sigma of priors. m: cameras of a car are not farther apart. log: of the metres of a scene's
# unit, where no speed is known. Of time: quartz clocks differ by less
REACH_M, UNKNOWN_UNIT, PACE = 2.0, 0.7, 1e-4
# maximum number of steps of the problem; before which of them broken pairs are left out, and
# the noise is weighed anew
STEPS, SIFTED, WEIGHED = 30, 2, (4, 7)
# degrees RMS, and times the median of a camera's pairs: a pair whose rotations are off by more is
# broken. Of a rendered rig one was off by 1.1 degrees, the others by 0.15 at most
BROKEN_DEG, BROKEN = 0.4, 4.0
# sigmas, and degrees, of the rotation by which a camera jumps within a stretch: of made rigs that
# stay as they are 5.0 and 0.18 at most, of those with a bump of 0.3 degrees 7.9 and 0.25 at least
JUMP, JUMP_DEG = 6.5, 0.2
# of steps, in sigmas; below it they end
SETTLED = 0.02
# s: noise between keyframes is that of knots so far apart, times the square of how far they are
USUAL_GAP_S = 0.2
# sigmas: a residual beyond it counts less
OUTLIER = 3.5
# s: how long the error of a direction of travel lasts
SLOW_S = 1.0
# of numeric derivatives: rad, m, s, logarithms
STEP = 1e-6

SceneKey = tuple[str, int]
# of a block of unknowns: of a camera's place, its name
BlockKey = str | tuple[str, Any]


@dataclass(frozen=True)
class Place:
    """Where a camera sits: x' = rotation x + translation_m, from the base's axes to its own.

    late_s: of its stamps, against those of the base, both from the first image on, at middle_s;
    pace: by how much more a second later.
    """

    rotation: Floats = field(default_factory=lambda: np.eye(3))
    translation_m: Floats = field(default_factory=lambda: np.zeros(3))
    late_s: float = 0.0
    pace: float = 0.0
    middle_s: float = 0.0

    def moved(self, step: Floats) -> Place:
        """Return the place a step (PLACE,) away."""
        return Place(rotation_matrices(step[None, :3])[0] @ self.rotation,
                     self.translation_m + step[3:6], self.late_s + float(step[6]),
                     self.pace + float(step[7]), self.middle_s)

    def on_base(self, seconds: Floats) -> Floats:
        """Return the base's times (n,) of those of this camera."""
        return seconds - self.late_s - self.pace * (seconds - self.middle_s)

    def on_own(self, seconds: Floats) -> Floats:
        """Return this camera's times (n,) of those of the base."""
        return seconds + self.late_s + self.pace * (seconds + self.late_s - self.middle_s)


@dataclass(frozen=True)
class Gauge:
    """From a scene's frame to its reference's: exp(log_scale) rotation X + shift."""

    rotation: Floats
    shift: Floats
    log_scale: float

    def moved(self, step: Floats) -> Gauge:
        """Return the similarity a step (GAUGE,) away."""
        return Gauge(rotation_matrices(step[None, :3])[0] @ self.rotation,
                     self.shift + step[3:6], self.log_scale + float(step[6]))


@dataclass(frozen=True)
class Pair:
    """A scene of a camera beside its reference scene. rows: (r,) its keyframes that count."""

    reference: SceneKey
    other: SceneKey
    rows: Ints
    gauge: Gauge


@dataclass(frozen=True)
class Noise:
    """One sigma of the residuals beyond the scenes' own noise.

    turn (rad), move: of each keyframe; turn_between, move_between: halfway between two keyframes
    of the reference that are USUAL_GAP_S apart. Moves are in steps of the path between keyframes.
    turn_slow: of a rotation, which adds up (rad per root of a second); way_slow: of the direction
    of travel (rad), which lasts SLOW_S.
    """

    turn: float = 2e-4
    move: float = 3e-3
    turn_between: float = 1e-3
    move_between: float = 5e-3
    turn_slow: float = 1e-4
    way_slow: float = 1e-3

    @property
    def sizes(self) -> Floats:
        """Return (6,) all of them; those that are slow last."""
        return np.array([self.turn, self.move, self.turn_between, self.move_between,
                         self.turn_slow, self.way_slow])


# smallest and largest sizes, and the factors that are tried
NOISES = (Noise(2e-5, 2e-4, 2e-5, 2e-4, 1e-6, 2e-5), Noise(2e-2, 0.3, 2e-2, 0.3, 1e-2, 5e-2))
FACTORS = (4.0, 4.0, 2.0, 1.4)


@dataclass(frozen=True)
class Rows:
    """The residuals of the pairs of one reference scene, linearised, and what their noise is.

    off: (6r,) measured less predicted; jacobian: (6r, l) of the prediction, by the unknowns and
    the lenses; known: (6r, 6r) covariance by the scenes; spread: (4, 6r) of which Noise's first
    sizes are times; slow: (2, 6r, 6r) covariances of its last two, each of size 1.
    """

    off: Floats
    jacobian: Floats
    known: Floats
    spread: Floats
    slow: Floats

    def covariance(self, noise: Noise) -> Floats:
        """Return (6r, 6r) the covariance of the residuals."""
        fast, slow = np.split(noise.sizes**2, [len(self.spread)])
        return np.asarray(self.known + np.diag(fast @ self.spread**2)
                          + np.tensordot(slow, self.slow, 1))

    def whitened(self, noise: Noise) -> tuple[Floats, Floats, float]:
        """Return jacobian and off with unit noise, and the log of the noise's size."""
        root = np.linalg.cholesky(self.covariance(noise))
        both = solve_triangular(root, np.column_stack([self.jacobian, self.off]), lower=True)
        return both[:, :-1], both[:, -1], float(np.log(np.diag(root)).sum())

    def without_outliers(self, noise: Noise, step: Floats) -> Rows:
        """Return the same where residuals far beyond the noise have more of it."""
        left = np.abs(self.off - self.jacobian @ step)
        sigmas = left / np.sqrt(np.diag(self.covariance(noise)))
        worst = np.repeat(sigmas.reshape(-1, 6).max(axis=1), 6)
        return replace(self, spread=self.spread * np.maximum(1.0, worst / OUTLIER)**2)


@dataclass(frozen=True)
class Matched:
    """The rotation from camera a's axes to b's (3, 3) that matches of both show.

    covariance: (3, 3) of small rotations in b's axes. follow: by camera, (3, n) of these by its
    lens.
    """

    a: str
    b: str
    rotation: Floats
    covariance: Floats
    follow: Mapping[str, Floats]


@dataclass(frozen=True)
class Problem:
    """The present state of a rig.

    places: of all cameras. units: log of the metres in a unit of each reference scene; unit_known:
    its prior, value and sigma. matched: what else shows rotations. broken: the pairs left out.
    """

    cameras: Mapping[str, CameraPaths]
    base: str
    places: Mapping[str, Place]
    units: Mapping[SceneKey, float]
    unit_known: Mapping[SceneKey, tuple[float, float]]
    pairs: tuple[Pair, ...]
    noise: Noise = Noise()
    matched: tuple[Matched, ...] = ()
    broken: tuple[Pair, ...] = ()

    def scene(self, key: SceneKey) -> ScenePath:
        """Return a scene by its camera and number."""
        return self.cameras[key[0]].scenes[key[1]]

    @cached_property
    def where(self) -> dict[BlockKey, slice]:
        """Return the places of each block: those of the m unknowns, then those of the lenses."""
        sizes: list[tuple[BlockKey, int]] = [
            (name, PLACE) for name in self.places if name != self.base]
        sizes += [(('unit', key), 1) for key in self.units]
        sizes += [(('gauge', n), GAUGE) for n in range(len(self.pairs))]
        sizes += [(('lens', name), len(self.cameras[name].lens_covariance))
                  for name in self.places]
        ends = np.cumsum([0, *(size for _, size in sizes)]).tolist()
        return {name: slice(start, end)
                for (name, _), start, end in zip(sizes, ends[:-1], ends[1:], strict=True)}

    @property
    def unknowns(self) -> int:
        """Return m, how many unknowns there are."""
        return int(min(self.where['lens', name].start for name in self.places))

    @property
    def count(self) -> int:
        """Return l, how many there are with the lenses."""
        return int(max(place.stop for place in self.where.values()))

    @property
    def groups(self) -> list[list[int]]:
        """Return the places of the pairs of each reference scene."""
        keys = dict.fromkeys(pair.reference for pair in self.pairs)
        return [[n for n, pair in enumerate(self.pairs) if pair.reference == key] for key in keys]

    def when(self, pair: Pair) -> Floats:
        """Return (r,) the times of a pair's keyframes on the clock of the reference's camera."""
        own, its = self.places[pair.other[0]], self.places[pair.reference[0]]
        return its.on_own(own.on_base(self.scene(pair.other).seconds[pair.rows]))

    def off(self, pair: Pair) -> Floats:
        """Return (r, 6) measured less predicted."""
        other, its = self.scene(pair.other), self.places[pair.reference[0]]
        own, gauge = self.places[pair.other[0]], pair.gauge
        rotations, translations = self.scene(pair.reference).trajectory.at(self.when(pair))
        across = own.rotation @ its.rotation.T
        lever = own.translation_m - across @ its.translation_m
        scale, unit = np.exp(gauge.log_scale), np.exp(self.units[pair.reference])
        turned = across @ rotations
        shifted = turned @ gauge.shift
        there = (shifted + translations @ across.T + lever / unit) / scale
        measured = other.trajectory
        return np.concatenate([logarithms(
            measured.rotations[pair.rows] @ (turned @ gauge.rotation).transpose(0, 2, 1)),
            measured.translations[pair.rows] - there], axis=1)

    def by_knots(self, pair: Pair) -> Floats:
        """Return (r, 6, 6k) derivatives of what is predicted by the reference's k poses."""
        its, own, gauge = self.places[pair.reference[0]], self.places[pair.other[0]], pair.gauge
        path, when = self.scene(pair.reference).trajectory, self.when(pair)
        across, scale = own.rotation @ its.rotation.T, np.exp(gauge.log_scale)
        follow = np.zeros((len(when), 6, 6))
        follow[:, :3, :3] = across
        follow[:, 3:, :3] = -cross(across @ path.at(when)[0] @ gauge.shift) @ across / scale
        follow[:, 3:, 3:] = across / scale
        return np.asarray(np.einsum('rab,rbkc->rakc', follow, path.by_knots(when)).reshape(
            len(when), 6, -1))

    def moved_in(self, n: int, name: BlockKey, step: Floats) -> Floats:
        """Return (r, 6) the residuals of a pair after a step of one of its blocks."""
        pair, now = self.pairs[n], self
        if isinstance(name, str):
            now = replace(self, places={**self.places, name: self.places[name].moved(step)})
        elif name == ('gauge', n):
            pair = replace(pair, gauge=pair.gauge.moved(step))
        else:
            key = pair.reference
            now = replace(self, units={**self.units, key: self.units[key] + float(step[0])})
        return now.off(pair)

    def linearised(self, members: Sequence[int]) -> Rows:
        """Return the residuals of the pairs of one reference scene, by unknowns and lenses."""
        key = self.pairs[members[0]].reference
        reference, its_lens = self.scene(key), self.where['lens', key[0]]
        offs, jacobians, spreads, slows, knots, owns = [], [], [], [], [], []
        for n in members:
            pair = self.pairs[n]
            other, off, by_knots = self.scene(pair.other), self.off(pair), self.by_knots(pair)
            jacobian = np.zeros((*off.shape, self.count))
            blocks: tuple[BlockKey, ...] = (
                key[0], pair.other[0], ('unit', key), ('gauge', n))
            for name in blocks:
                if name != self.base:
                    place = self.where[name]
                    for column, step in enumerate(STEP * np.eye(place.stop - place.start)):
                        jacobian[:, :, place.start + column] = (
                            self.moved_in(n, name, -step) - self.moved_in(n, name, step)
                        ) / (2 * STEP)
            rows = (6 * pair.rows[:, None] + np.arange(6)).ravel()
            follow = other.follow[rows].reshape(*off.shape, -1)
            its_follow = by_knots @ reference.follow
            # poses that were measured follow their lens
            jacobian[:, :, self.where['lens', pair.other[0]]] -= follow
            jacobian[:, :, its_lens] += its_follow
            offs.append(off.ravel())
            jacobians.append(jacobian.reshape(off.size, -1))
            spreads.append(self._spread(pair))
            slows.append(self._slow(pair))
            knots.append(by_knots.reshape(off.size, -1))
            owns.append(other.covariance[np.ix_(rows, rows)])
        together = np.concatenate(knots)
        known = together @ reference.covariance @ together.T + block_diag(*owns)
        return Rows(np.concatenate(offs), np.concatenate(jacobians), known,
                    np.concatenate(spreads, axis=1),
                    np.stack([block_diag(*each) for each in zip(*slows, strict=True)]))

    def _spread(self, pair: Pair) -> Floats:
        """Return (4, 6r) of which Noise's sizes are times."""
        knots, when = self.scene(pair.reference).seconds, self.when(pair)
        piece = np.clip(np.searchsorted(knots, when, side='right') - 1, 0, len(knots) - 2)
        gap = knots[piece + 1] - knots[piece]
        share = np.clip((when - knots[piece]) / gap, 0.0, 1.0)
        between = 4 * share * (1 - share) * (gap / USUAL_GAP_S)**2
        way = float(np.median(np.linalg.norm(np.diff(self.scene(pair.other).centres, axis=0),
                                             axis=1)))
        turn, move = np.array([1, 1, 1, 0, 0, 0.0]), way * np.array([0, 0, 0, 1, 1, 1.0])
        one = np.ones(len(when))
        return np.stack([np.outer(size, kind).ravel() for size, kind in (
            (one, turn), (one, move), (between, turn), (between, move))])

    def _slow(self, pair: Pair) -> Floats:
        """Return (2, 6r, 6r) the covariances of slow noise of size 1: of rotations, of the way.

        A pose that was measured has all errors until then in its own axes.
        """
        path = self.scene(pair.other)
        rotations = path.trajectory.rotations[pair.rows]
        seconds, count = path.seconds[pair.rows], len(pair.rows)
        since = np.einsum('iab,jcb->iajc', rotations, rotations) * np.tri(count)[:, None, :, None]
        after = np.sqrt(np.diff(seconds, prepend=seconds[0]))
        centres = path.centres[pair.rows]
        ways = np.linalg.norm(np.diff(centres, axis=0, prepend=centres[:1]), axis=1)
        lasts = np.exp(-np.abs(seconds[:, None] - seconds) / SLOW_S)
        turned = (since * after[:, None]).reshape(3 * count, -1)
        moved = (since * ways[:, None]).reshape(3 * count, -1)
        found = np.zeros((2, count, 6, count, 6))
        found[0, :, :3, :, :3] = (turned @ turned.T).reshape(count, 3, count, 3)
        found[1, :, 3:, :, 3:] = (moved @ np.kron(lasts, np.eye(3)) @ moved.T).reshape(
            count, 3, count, 3)
        return found.reshape(2, 6 * count, 6 * count)

    def prior(self, lenses: bool = False) -> tuple[Floats, Floats]:
        """Return the information (l, l) of all that is known before, and its score (l,).

        lenses: whether that of each camera's own turns about its lens is part of it.
        """
        information, score = np.zeros((self.count, self.count)), np.zeros(self.count)
        for name in self.places if lenses else ():
            place = self.where['lens', name]
            information[place, place] = np.linalg.inv(self.cameras[name].lens_covariance)
        for key, (known, sigma) in self.unit_known.items():
            place = self.where['unit', key]
            information[place, place] = 1 / sigma**2
            score[place] = (known - self.units[key]) / sigma**2
        for block, place in self.where.items():
            if isinstance(block, str):
                own = self.places[block]
                inverse = np.diag([0, 0, 0, *[REACH_M**-2] * 3, 0, PACE**-2])
                information[place, place] = inverse
                score[place] = -inverse @ [0, 0, 0, *own.translation_m, 0, own.pace]
        for each in self.matched:
            off, jacobian = self.off_matches(each)
            # the lenses stay: what follows them is no better known than they are
            covariance = each.covariance + sum(
                follow @ self.cameras[name].lens_covariance @ follow.T
                for name, follow in each.follow.items())
            weighted = np.linalg.solve(covariance, jacobian).T
            information += weighted @ jacobian
            score += weighted @ off
        return information, score

    def off_matches(self, found: Matched) -> tuple[Floats, Floats]:
        """Return (3,) measured less predicted, and (3, l) derivatives of what is predicted."""
        across = self.places[found.b].rotation @ self.places[found.a].rotation.T
        off, jacobian = logarithms((found.rotation @ across.T)[None])[0], np.zeros(
            (3, self.count))
        for name, turn in ((found.a, -across), (found.b, np.eye(3))):
            if name != self.base:
                jacobian[:, self.where[name]][:, :3] = turn
            # what was measured follows the lens
            jacobian[:, self.where['lens', name]] = -found.follow[name]
        return off, jacobian

    def moved(self, step: Floats) -> Problem:
        """Return the problem a step (m,) away."""
        where = self.where
        found = replace(
            self, places={name: own.moved(step[where[name]]) if name in where else own
                          for name, own in self.places.items()},
            units={key: value + float(step[where['unit', key]][0])
                   for key, value in self.units.items()},
            pairs=tuple(replace(pair, gauge=pair.gauge.moved(step[where['gauge', n]]))
                        for n, pair in enumerate(self.pairs)))
        found.__dict__['where'] = where
        return found


@dataclass(frozen=True)
class Solved:
    """The optimum given each camera's own lens.

    covariance: (m, m) if the lenses were known; by_lenses: (m, m) by what they are off. own: by
    camera, by group: (PLACE,) how far it is off all, and (PLACE,) its variances. lens_distance: by
    camera, by how many of its own sigmas paths would move its lens. jumped: the cameras that turn
    against the base within a stretch. settled: whether the steps came to an end.
    """

    problem: Problem
    covariance: Floats
    by_lenses: Floats
    own: Mapping[str, Sequence[tuple[Floats, Floats]]]
    lens_distance: Mapping[str, float]
    jumped: frozenset[str] = frozenset()
    settled: bool = True

    def sigma(self, name: str) -> Floats:
        """Return (PLACE,) the sigmas of a camera, larger where its stretches differ by more."""
        place = self.problem.where[name]
        return np.asarray(np.sqrt(
            np.diag(self.covariance)[place] * self.disagreement(name)**2
            + np.diag(self.by_lenses)[place]))

    def disagreement(self, name: str) -> Floats:
        """Return (PLACE,) by how much stretches differ, over what their sigmas say; 1 or more."""
        groups = self.own[name]
        if len(groups) < 2:
            return np.ones(PLACE)
        values, variances = (np.array(each) for each in zip(*groups, strict=True))
        means = np.sum(values / variances, axis=0) / np.sum(1 / variances, axis=0)
        squares = np.sum((values - means)**2 / variances, axis=0) / (len(groups) - 1)
        return np.asarray(np.sqrt(np.maximum(squares, 1.0)))


def solved(problem: Problem) -> Solved:
    """Return the optimum of a problem near it."""
    settled = False
    for number in range(STEPS):
        if number == SIFTED:
            problem = _without_broken(problem)
        groups = [problem.linearised(members) for members in problem.groups]
        if number in WEIGHED:
            problem = replace(problem, noise=_weighed(problem, groups))
        found = _normal(problem, groups)
        if number > min(WEIGHED):
            groups = [rows.without_outliers(problem.noise, found.step) for rows in groups]
            found = _normal(problem, groups)
        unknowns = slice(problem.unknowns)
        step, information = found.step, found.information[unknowns, unknowns]
        problem = problem.moved(_shortened(problem, step))
        settled = bool(number > max(WEIGHED)
                       and step[unknowns] @ information @ step[unknowns] < SETTLED**2)
        if settled:
            break
    prior = problem.prior()[0][unknowns, unknowns]
    own: dict[str, list[tuple[Floats, Floats]]] = {
        name: [] for name in problem.places if name != problem.base}
    for members, rows in zip(problem.groups, groups, strict=True):
        jacobian, off, _ = rows.whitened(problem.noise)
        jacobian, off = jacobian[:, unknowns], off - jacobian @ step
        alone = np.linalg.inv(jacobian.T @ jacobian + prior + 1e-9 * np.diag(
            np.diag(information)))
        away = alone @ (jacobian.T @ off)
        for name in {problem.pairs[n].other[0] for n in members}:
            place = problem.where[name]
            own[name].append((away[place], np.diag(alone)[place]))
    return Solved(problem, *_with_lenses(problem, found), own, _lens_distances(problem, groups),
                  _jumped(problem), settled)


def _without_broken(problem: Problem) -> Problem:
    """Return a problem without the pairs whose two scenes turn differently: one is broken."""
    off = np.array([np.degrees(np.sqrt(np.mean(np.sum(problem.off(pair)[:, :3]**2, axis=1))))
                    for pair in problem.pairs])
    names = np.array([pair.other[0] for pair in problem.pairs])
    usual = np.array([np.median(off[names == name]) for name in names])
    sound = off <= np.maximum(BROKEN_DEG, BROKEN * usual)
    kept, broken = (tuple(pair for pair, good in zip(problem.pairs, sound, strict=True)
                          if good == which) for which in (True, False))
    return replace(problem, pairs=kept, broken=broken)


def _jumped(problem: Problem) -> frozenset[str]:
    """Return the cameras whose rotation against the base jumps within a stretch.

    Or whose last pair is broken: after others, later ones show where the camera sits.
    """
    groups = [problem.linearised(members) for members in problem.groups]
    normal, unknowns = _normal(problem, groups), slice(problem.unknowns)
    step = normal.step[unknowns]
    covariance = np.asarray(np.linalg.inv(normal.information[unknowns, unknowns]), np.float64)
    found = {problem.pairs[n].other[0]
             for members, rows in zip(problem.groups, groups, strict=True)
             for n, jumps in zip(members, _jumps(problem, members, rows, step, covariance),
                                 strict=True) if jumps}
    for pair in problem.broken:
        later = [each for each in problem.pairs if each.other[0] == pair.other[0]
                 and problem.when(each)[-1] > problem.when(pair)[-1]]
        found |= set() if later else {pair.other[0]}
    return frozenset(found)


def _jumps(problem: Problem, members: Sequence[int], rows: Rows, step: Floats,
           covariance: Floats) -> list[bool]:
    """Return whether the camera jumps within each of the pairs of one reference scene.

    A score test: how much a rotation of the camera from one of its keyframes on would explain. Of
    the first and last keyframe alone that is an error of the path's end. step: (m,) to the
    optimum; covariance: (m, m).
    """
    blocks = []
    for pair in (problem.pairs[n] for n in members):
        count = len(pair.rows)
        turned = np.zeros((count, 6, 3))
        turned[:, :3] = np.eye(3)
        turned[:, 3:] = -cross(problem.scene(pair.other).trajectory.translations[pair.rows])
        # by where the jump begins: at the third keyframe at the earliest, the last but one latest
        later = np.tri(count)[:, 2:-1, None, None] * turned[:, None]
        blocks.append(later.transpose(0, 2, 1, 3).reshape(6 * count, -1))
    unknowns = len(step)
    white, off, _ = replace(rows, jacobian=np.column_stack(
        [rows.jacobian[:, :unknowns], block_diag(*blocks)])).whitened(problem.noise)
    known, turns = white[:, :unknowns], white[:, unknowns:]
    off = off - known @ step
    found, ends = [], np.cumsum([block.shape[1] for block in blocks])[:-1]
    for own in np.split(turns, ends, axis=1):
        score = (own.T @ off).reshape(-1, 3)
        by_known = (own.T @ known).reshape(len(score), 3, -1)
        own = own.reshape(len(off), -1, 3)
        information = (np.einsum('rka,rkb->kab', own, own)
                       - by_known @ covariance @ by_known.transpose(0, 2, 1))
        jump = np.linalg.solve(information, score[..., None])[..., 0]
        gains = np.sum(jump * score, axis=1)
        best = int(np.argmax(gains))
        found.append(bool(gains[best] > JUMP**2
                          and np.degrees(np.linalg.norm(jump[best])) > JUMP_DEG))
    return found


@dataclass(frozen=True)
class Normal:
    """The normal equations of all unknowns and the lenses.

    information: (l, l); step: (l,) to the optimum, 0 of lenses that are held. badness: of the
    noise, twice the log of the restricted likelihood with its sign changed.
    """

    information: Floats
    step: Floats
    badness: float


def _normal(problem: Problem, groups: Sequence[Rows], lenses: bool = False) -> Normal:
    """Return the normal equations. lenses: whether these are free, too."""
    information, score = problem.prior(lenses)
    badness = 0.0
    for rows in groups:
        jacobian, off, log = rows.whitened(problem.noise)
        information = information + jacobian.T @ jacobian
        score = score + jacobian.T @ off
        badness += float(off @ off) + 2 * log
    free = slice(problem.count if lenses else problem.unknowns)
    scale = 1 / np.sqrt(np.maximum(np.diag(information)[free], 1e-300))
    scaled = information[free, free] * scale[:, None] * scale + 1e-13 * np.eye(len(scale))
    step = np.zeros(len(score))
    step[free] = scale * np.linalg.solve(scaled, scale * score[free])
    badness += float(np.linalg.slogdet(scaled)[1]) - 2 * float(np.log(scale).sum())
    return Normal(information, step, badness - float(score @ step))


def _with_lenses(problem: Problem, found: Normal) -> tuple[Floats, Floats]:
    """Return the covariances (m, m) of the unknowns: with known lenses, and by the lenses."""
    free = slice(problem.unknowns)
    covariance = np.asarray(np.linalg.inv(found.information[free, free]), np.float64)
    by_lenses = np.zeros_like(covariance)
    for name in problem.places:
        follow = covariance @ found.information[free, problem.where['lens', name]]
        by_lenses += follow @ problem.cameras[name].lens_covariance @ follow.T
    return covariance, by_lenses


def _lens_distances(problem: Problem, groups: Sequence[Rows]) -> dict[str, float]:
    """Return by how many of its sigmas each lens would move if all were free, and noise as then.

    What lenses held apart leave would pass for noise otherwise.
    """
    freed = replace(problem, noise=_weighed(problem, groups, True))
    step = _normal(freed, groups, True).step
    return {name: distance(step[problem.where['lens', name]],
                           problem.cameras[name].lens_covariance) for name in problem.places}


def _weighed(problem: Problem, groups: Sequence[Rows], lenses: bool = False) -> Noise:
    """Return the sizes of the noise that explain the residuals best.

    lenses: whether these are free.
    """
    best = _normal(problem, groups, lenses).badness
    sizes, least, most = problem.noise.sizes, *(each.sizes for each in NOISES)
    for factor in FACTORS:
        for place in range(len(sizes)):
            for times in (factor, 1 / factor):
                tried = sizes.copy()
                tried[place] = np.clip(times * sizes[place], least[place], most[place])
                badness = _normal(
                    replace(problem, noise=Noise(*tried.tolist())), groups, lenses).badness
                if badness < best:
                    best, sizes = badness, tried
                    break
    return Noise(*sizes.tolist())


# rad, s, logarithms: the farthest a step goes; of metres all is linear
LONGEST = 0.5
METRES = slice(3, 6)


def _shortened(problem: Problem, step: Floats) -> Floats:
    places = [np.delete(step[place], METRES) for name, place in problem.where.items()
              if name[0] != 'lens']
    return np.asarray(step * min(1.0, LONGEST / max(float(np.abs(np.concatenate(places)).max()),
                                                    1e-12)))
