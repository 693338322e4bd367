# SPDX-License-Identifier: Apache-2.0
"""Paths of several cameras -> one rig, as one least-squares problem.

All cameras sit on one car. Where a camera with rotation R, translation l (x' = R x + l, from the
base's axes) and a clock that is late by o has a pose in a scene of its own, the reference scene,
mostly the base's, says where it must be at that time:

    rotation = R P(t - o) G,    translation = (R (P(t - o) g + T(t - o)) + l / m) / s

P, T: the base's pose; m: metres in a unit of its scene; G, g, s: the similarity between both
scenes. The unknowns are each camera's rotation, translation and clock, m, the similarities, and
each camera's lens, with the covariance that all of its turns give it: poses follow their lens.
In the end each lens is put back to what its own turns say, which is what is judged and written:
on rendered rigs the paths move it to no better place. Its covariance stays in that of places.

Beside the scenes' own noise there is what else no model has, at every keyframe, and how the car
shook between two keyframes of the reference: as large as the residuals say. So cameras with one
trigger gain, and a stretch counts less in which the car shakes.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

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
# maximum number of steps of the problem; before some of them the noise is weighed anew
STEPS, WEIGHED = 30, (3, 6)
# of steps, in sigmas; below it they end
SETTLED = 0.02
# s: noise between keyframes is that of knots so far apart, times the square of how far they are
USUAL_GAP_S = 0.2
# sigmas: a residual beyond it counts less
OUTLIER = 3.5
# of a lens's sigma: by how much each stretch may ask for a lens of its own. What all tracks of a
# stretch share looks like another lens: on rendered rigs poses alone moved fx by 3 sigmas
LENSES_DIFFER = 0.5
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
    """

    turn: float = 2e-4
    move: float = 3e-3
    turn_between: float = 1e-3
    move_between: float = 5e-3

    @property
    def sizes(self) -> Floats:
        """Return (4,) all of them."""
        return np.array([self.turn, self.move, self.turn_between, self.move_between])


# smallest and largest sizes, and the factors that are tried
NOISES = (Noise(2e-5, 2e-4, 2e-5, 2e-4), Noise(2e-2, 0.3, 2e-2, 0.3))
FACTORS = (4.0, 4.0, 2.0, 1.4)


@dataclass(frozen=True)
class Rows:
    """The residuals of the pairs of one reference scene, linearised, and what their noise is.

    off: (6r,) measured less predicted; jacobian: (6r, m) of the prediction; known: (6r, 6r)
    covariance by the scenes; spread: (4, 6r) of which Noise's sizes are times.
    """

    off: Floats
    jacobian: Floats
    known: Floats
    spread: Floats

    def covariance(self, noise: Noise) -> Floats:
        """Return (6r, 6r) the covariance of the residuals."""
        return np.asarray(self.known + np.diag((noise.sizes**2) @ self.spread**2))

    def whitened(self, noise: Noise) -> tuple[Floats, Floats, float]:
        """Return jacobian and off with unit noise, and the log of the noise's size."""
        root = np.linalg.cholesky(self.covariance(noise))
        both = np.linalg.inv(root) @ np.column_stack([self.jacobian, self.off])
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
    its prior, value and sigma. lenses: (n,) how far each camera's lens is off its own solution.
    matched: what else shows rotations.
    """

    cameras: Mapping[str, CameraPaths]
    base: str
    places: Mapping[str, Place]
    units: Mapping[SceneKey, float]
    unit_known: Mapping[SceneKey, tuple[float, float]]
    lenses: Mapping[str, Floats]
    pairs: tuple[Pair, ...]
    noise: Noise = Noise()
    matched: tuple[Matched, ...] = ()

    def scene(self, key: SceneKey) -> ScenePath:
        """Return a scene by its camera and number."""
        return self.cameras[key[0]].scenes[key[1]]

    @cached_property
    def where(self) -> dict[BlockKey, slice]:
        """Return the places of each block among the m unknowns."""
        sizes: list[tuple[BlockKey, int]] = [
            (name, PLACE) for name in self.places if name != self.base]
        sizes += [(('lens', name), len(value)) for name, value in self.lenses.items()]
        sizes += [(('unit', key), 1) for key in self.units]
        sizes += [(('gauge', n), GAUGE) for n in range(len(self.pairs))]
        ends = np.cumsum([0, *(size for _, size in sizes)]).tolist()
        return {name: slice(start, end)
                for (name, _), start, end in zip(sizes, ends[:-1], ends[1:], strict=True)}

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
        """Return the residuals of the pairs of one reference scene."""
        count = max(place.stop for place in self.where.values())
        key = self.pairs[members[0]].reference
        reference, its_lens = self.scene(key), self.where['lens', key[0]]
        offs, jacobians, spreads, knots, owns = [], [], [], [], []
        for n in members:
            pair = self.pairs[n]
            other, off, by_knots = self.scene(pair.other), self.off(pair), self.by_knots(pair)
            jacobian = np.zeros((*off.shape, count))
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
            off = off + follow @ self.lenses[pair.other[0]] - its_follow @ self.lenses[key[0]]
            offs.append(off.ravel())
            jacobians.append(jacobian.reshape(off.size, count))
            spreads.append(self._spread(pair))
            knots.append(by_knots.reshape(off.size, -1))
            owns.append(other.covariance[np.ix_(rows, rows)] + self._own_lens(
                pair.other, other.follow[rows]))
        together = np.concatenate(knots)
        known, at = (together @ reference.covariance @ together.T
                     + self._own_lens(key, together @ reference.follow)), 0
        for own in owns:
            known[at:at + len(own), at:at + len(own)] += own
            at += len(own)
        return Rows(np.concatenate(offs), np.concatenate(jacobians), known,
                    np.concatenate(spreads, axis=1))

    def _own_lens(self, key: SceneKey, follow: Floats) -> Floats:
        """Return the covariance of poses by what a scene's lens differs from its camera's."""
        return np.asarray(LENSES_DIFFER**2 * follow @ self.cameras[key[0]].lens_covariance
                          @ follow.T)

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

    def prior(self) -> tuple[Floats, Floats]:
        """Return the information (m, m) of all that is known before, and its score (m,)."""
        count = max(place.stop for place in self.where.values())
        information, score = np.zeros((count, count)), np.zeros(count)
        for name, value in self.lenses.items():
            place = self.where['lens', name]
            inverse = np.linalg.inv(self.cameras[name].lens_covariance)
            information[place, place] = inverse
            score[place] = -inverse @ value
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
            off, jacobian = self.off_matches(each, count)
            # lenses are put back in the end: what follows them is no better known than they are
            covariance = each.covariance + sum(
                follow @ self.cameras[name].lens_covariance @ follow.T
                for name, follow in each.follow.items())
            weighted = np.linalg.solve(covariance, jacobian).T
            information += weighted @ jacobian
            score += weighted @ off
        return information, score

    def off_matches(self, found: Matched, count: int) -> tuple[Floats, Floats]:
        """Return (3,) measured less predicted, and (3, m) derivatives of what is predicted."""
        across = self.places[found.b].rotation @ self.places[found.a].rotation.T
        off, jacobian = logarithms((found.rotation @ across.T)[None])[0], np.zeros((3, count))
        for name, turn in ((found.a, -across), (found.b, np.eye(3))):
            if name != self.base:
                jacobian[:, self.where[name]][:, :3] = turn
            # what was measured follows the lens
            jacobian[:, self.where['lens', name]] = -found.follow[name]
            off = off + found.follow[name] @ self.lenses[name]
        return off, jacobian

    def moved(self, step: Floats) -> Problem:
        """Return the problem a step (m,) away."""
        where = self.where
        found = replace(
            self, places={name: own.moved(step[where[name]]) if name in where else own
                          for name, own in self.places.items()},
            units={key: value + float(step[where['unit', key]][0])
                   for key, value in self.units.items()},
            lenses={name: value + step[where['lens', name]]
                    for name, value in self.lenses.items()},
            pairs=tuple(replace(pair, gauge=pair.gauge.moved(step[where['gauge', n]]))
                        for n, pair in enumerate(self.pairs)))
        found.__dict__['where'] = where
        return found


@dataclass(frozen=True)
class Solved:
    """The optimum given each camera's own lens. covariance: (m, m); own: by camera, by group.

    Of a group these are (PLACE,) how far it is off all, and (PLACE,) its variances.
    lens_distance: by camera, by how many of its own sigmas paths would move its lens. settled:
    whether the steps came to an end.
    """

    problem: Problem
    covariance: Floats
    own: Mapping[str, Sequence[tuple[Floats, Floats]]]
    lens_distance: Mapping[str, float]
    settled: bool = True

    def sigma(self, name: str) -> Floats:
        """Return (PLACE,) the sigmas of a camera, larger where its stretches differ by more."""
        place = self.problem.where[name]
        return np.asarray(np.sqrt(np.diag(self.covariance)[place]) * self.disagreement(name))

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
        groups = [problem.linearised(members) for members in problem.groups]
        if number in WEIGHED:
            problem = replace(problem, noise=_weighed(problem, groups))
        step, information, _ = _step(problem, groups)
        if number > min(WEIGHED):
            groups = [rows.without_outliers(problem.noise, step) for rows in groups]
            step, information, _ = _step(problem, groups)
        problem = problem.moved(_shortened(problem, step))
        settled = bool(number > max(WEIGHED) and step @ information @ step < SETTLED**2)
        if settled:
            break
    prior, _ = problem.prior()
    covariance = np.asarray(np.linalg.inv(information), np.float64)
    own: dict[str, list[tuple[Floats, Floats]]] = {
        name: [] for name in problem.places if name != problem.base}
    for members, rows in zip(problem.groups, groups, strict=True):
        jacobian, off, _ = rows.whitened(problem.noise)
        alone = np.linalg.inv(jacobian.T @ jacobian + prior + 1e-9 * np.diag(
            np.diag(information)))
        away = alone @ (jacobian.T @ (off - jacobian @ step))
        for name in {problem.pairs[n].other[0] for n in members}:
            place = problem.where[name]
            own[name].append((away[place], np.diag(alone)[place]))
    distances = {name: distance(value, problem.cameras[name].lens_covariance)
                 for name, value in problem.lenses.items()}
    return Solved(*_with_own_lenses(problem, covariance), own, distances, settled)


def _with_own_lenses(problem: Problem, covariance: Floats) -> tuple[Problem, Floats]:
    """Return the optimum where no lens moves, and its covariance (m, m) with those of lenses."""
    count, where = len(covariance), problem.where
    step, known = np.zeros(count), np.zeros((count, count))
    for name, value in problem.lenses.items():
        place = where['lens', name]
        step[place], known[place, place] = -value, problem.cameras[name].lens_covariance
    lens = np.concatenate([np.arange(count)[where['lens', name]] for name in problem.lenses])
    # how all follows the lenses
    follow = np.linalg.solve(covariance[np.ix_(lens, lens)], covariance[lens]).T
    left = covariance - follow @ covariance[lens]
    return problem.moved(follow @ step[lens]), left + follow @ known[np.ix_(lens, lens)] @ follow.T


def _step(problem: Problem, groups: Sequence[Rows]) -> tuple[Floats, Floats, float]:
    """Return the step to the optimum (m,), the information (m, m), and the badness of the noise.

    That is twice the log of the restricted likelihood, with its sign changed.
    """
    information, score = problem.prior()
    badness = 0.0
    for rows in groups:
        jacobian, off, log = rows.whitened(problem.noise)
        information = information + jacobian.T @ jacobian
        score = score + jacobian.T @ off
        badness += float(off @ off) + 2 * log
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = information * scale[:, None] * scale + 1e-13 * np.eye(len(scale))
    step = scale * np.linalg.solve(scaled, scale * score)
    badness += float(np.linalg.slogdet(scaled)[1]) - 2 * float(np.log(scale).sum())
    return step, information, badness - float(score @ step)


def _weighed(problem: Problem, groups: Sequence[Rows]) -> Noise:
    """Return the sizes of the noise that explain the residuals best."""
    best = _step(problem, groups)[2]
    sizes, least, most = problem.noise.sizes, *(each.sizes for each in NOISES)
    for factor in FACTORS:
        for place in range(len(sizes)):
            for times in (factor, 1 / factor):
                tried = sizes.copy()
                tried[place] = np.clip(times * sizes[place], least[place], most[place])
                badness = _step(replace(problem, noise=Noise(*tried.tolist())), groups)[2]
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
