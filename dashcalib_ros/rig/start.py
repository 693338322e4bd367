# SPDX-License-Identifier: Apache-2.0
"""Which scenes of cameras are of one time, and a rig to start from, in closed form.

All cameras of a car turn with it at the same time, whatever they look at: the clocks of two of
them are where their turning fits best. The rotation that takes one's turning, and its direction of
travel, to the other's, is where the problem starts.
"""
from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera.rotation import centres_of, nearest_rotation
from dashcalib_ros.input.motion import Samples
from dashcalib_ros.rig.joint import UNKNOWN_UNIT, Gauge, Pair, Place, Problem, SceneKey
from dashcalib_ros.rig.paths import CameraPaths, ScenePath

# s between the offsets that are tried, first and then
COARSE_S, FINER_S = 0.2, (0.05, 0.01)
# of the squared turning in two scenes; cameras that share less do not turn alike
LEAST_EXPLAINED = 0.8
# minimum angle that both turned together, rad; and what the score of a wrong offset may reach
LEAST_TURNED, RIVAL = np.radians(15.0), 0.8
# s; farther from the best offset, another one is another alignment; and stretches that must agree
# on clocks that are farther apart: a single turn looks like many others
APART_S, AGREEING = 1.0, 2
# minimum number of keyframes of a scene inside another one
LEAST_SHARED = 6
# m/s: where no speed is known, so fast a car goes
USUAL_SPEED = 8.0
# weight of a step's direction beside that of its turning, rad
DIRECTION = 0.02

# in one stretch: one sigma of a speed beyond that of its scale, which all share, and of the metres
# where no part is straight
SPEED_SIGMA, BENT_SIGMA = 0.01, 0.02
# of a path's largest bend, below which it is straight: in a bend a camera is faster than a wheel
UNBENT = 0.3


@dataclass(frozen=True)
class Metres:
    """What gives a path its metres.

    speed: of the car (n,), m/s, at times (n,) on the clock of the base; 0 where it is not known.
    sigma: the share by which all of it may be off.
    """

    speed: Callable[[Floats], Floats]
    sigma: float = 0.0

    @classmethod
    def by(cls, speed: Samples, late_s: float, sigma: float) -> Metres:
        """Return the metres by a measured speed. late_s: of its clock against the base's."""
        return cls(lambda seconds: speed.at(seconds + late_s)[:, 0], sigma)


@dataclass(frozen=True)
class Aligned:
    """How late a camera's clock is against another's; rotation (3, 3) from its axes.

    explained: of the squared turning that both saw. turned: rad, of that. rival: the score of the
    next best other alignment, of the best one's. stretches: how many both saw. apart_s: how far
    the clocks are from being one clock.
    """

    late_s: float
    rotation: Floats
    explained: float
    turned: float
    rival: float
    stretches: int
    apart_s: float

    @property
    def found(self) -> bool:
        """Return whether both cameras turn alike, at one time only."""
        return (self.explained >= LEAST_EXPLAINED and self.turned >= LEAST_TURNED
                and not self.other_side and not self.ambiguous)

    @property
    def ambiguous(self) -> bool:
        """Return whether it may be by chance that they turn alike at this time."""
        return abs(self.apart_s) > APART_S and (
            self.stretches < AGREEING or self.rival > RIVAL)

    @property
    def other_side(self) -> bool:
        """Return whether one turns to the other side: that, or it is upside down."""
        return bool(self.rotation[1, 1] < 0)


def aligned(camera: CameraPaths, base: CameraPaths, near_s: float | None = None,
            within_s: float = np.inf) -> Aligned | None:
    """Return how a camera's clock and axes fit to another's; None without any shared turning.

    near_s: of how late it is, where both have one clock; within_s: how far it may be from that.
    """
    spans = [(own.seconds[0] - its.seconds[-1], own.seconds[-1] - its.seconds[0])
             for own in camera.scenes for its in base.scenes]
    if not spans:
        return None
    low, high = min(low for low, _ in spans), max(high for _, high in spans)
    if near_s is not None:
        low, high = max(low, near_s - within_s), min(high, near_s + within_s)
    tried = np.arange(low, high + COARSE_S, COARSE_S)
    tried = np.array([late for late in tried if any(a < late < b for a, b in spans)])
    scores = np.array([_score(camera, base, late)[0] for late in tried])
    if not len(scores) or scores.max() <= 0:
        return None
    # of alignments that fit as well, the one of a common clock
    best = tried[int(np.argmax(scores))]
    if near_s is not None and abs(best - near_s) > APART_S:
        close = np.abs(tried - near_s) < APART_S
        if close.any() and scores[close].max() > RIVAL * scores.max():
            best = tried[close][int(np.argmax(scores[close]))]
    others = scores[np.abs(tried - best) > APART_S]
    late, width = float(best), COARSE_S
    for step in FINER_S:
        late = float(max(late + np.arange(-width, width + step / 2, step),
                         key=lambda each: _score(camera, base, each)[0]))
        width = step
    score, rotation, explained, turned = _score(camera, base, late)
    seen = {n for n, own in enumerate(camera.scenes) for its in base.scenes
            if len(_shared(own, its, late)) >= LEAST_SHARED}
    return Aligned(late, rotation, explained, turned,
                   max(float(others.max(initial=0.0)), 0.0) / max(score, 1e-12), len(seen),
                   0.0 if near_s is None else late - near_s)


def _shared(own: ScenePath, its: ScenePath, late: float) -> Floats:
    """Return the times of a camera's keyframes, on its clock, that the other's scene has, too."""
    return own.seconds[its.within(own.seconds - late)]


def _score(camera: CameraPaths, base: CameraPaths, late: float
           ) -> tuple[float, Floats, float, float]:
    """Return the score of an offset, the rotation, the share explained, and the rad turned."""
    turns, theirs, ways, their_ways = [], [], [], []
    for own in camera.scenes:
        for its in base.scenes:
            seconds = _shared(own, its, late)
            if len(seconds) >= LEAST_SHARED:
                (turn, way), (its_turn, its_way) = own.steps(seconds), its.steps(
                    seconds - late)
                turns.append(turn)
                theirs.append(its_turn)
                ways.append(_unit(way))
                their_ways.append(_unit(its_way))
    if not turns:
        return 0.0, np.eye(3), 0.0, 0.0
    all_turns, its_turns = np.concatenate(turns), np.concatenate(theirs)
    both = all_turns.T @ its_turns + DIRECTION**2 * (
        np.concatenate(ways).T @ np.concatenate(their_ways))
    rotation = nearest_rotation(both)
    energy = float(np.sum(all_turns**2) + np.sum(its_turns**2)) / 2
    left = float(np.sum((all_turns - its_turns @ rotation.T)**2))
    explained = 1 - left / max(energy, 1e-12)
    turned = float(sum(np.linalg.norm(each.sum(axis=0)) for each in turns))
    return energy - left / (1 - LEAST_EXPLAINED), rotation, explained, turned


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1e-12)[:, None])


def problem_of(cameras: Mapping[str, CameraPaths], base: str, found: Mapping[str, Aligned],
               metres: Metres | None) -> Problem:
    """Return the problem to start with. found: the cameras that are aligned with the base.

    metres: None: unknown.
    """
    names = [base, *found]
    middles = {name: float(np.mean([np.mean(scene.seconds) for scene in cameras[name].scenes]))
               for name in names}
    places = {base: Place()} | {
        name: Place(each.rotation, late_s=each.late_s, middle_s=middles[name])
        for name, each in found.items()}
    pairs: list[Pair] = []
    for name in found:
        for n in range(len(cameras[name].scenes)):
            key = (name, n)
            pairs += [pair for m in range(len(cameras[base].scenes))
                      if (pair := _pair(cameras, places, (base, m), key)) is not None]
    known = {key: _unit_of(cameras[key[0]].scenes[key[1]], metres)
             for key in dict.fromkeys(pair.reference for pair in pairs)}
    used = {name for pair in pairs for name in (pair.reference[0], pair.other[0])} | {base}
    return Problem({name: cameras[name] for name in names if name in used}, base,
                   {name: place for name, place in places.items() if name in used},
                   {key: value for key, (value, _) in known.items()}, known, tuple(pairs))


def _pair(cameras: Mapping[str, CameraPaths], places: Mapping[str, Place], reference: SceneKey,
          other: SceneKey) -> Pair | None:
    its, own = (cameras[key[0]].scenes[key[1]] for key in (reference, other))
    place = places[other[0]]
    when = places[reference[0]].on_own(place.on_base(own.seconds))
    rows = np.flatnonzero(its.within(when))
    if len(rows) < LEAST_SHARED:
        return None
    rotations, translations = its.trajectory.at(when[rows])
    centres = centres_of(rotations, translations)
    across = place.rotation @ places[reference[0]].rotation.T
    turned = np.sum((across @ rotations).transpose(0, 2, 1)
                    @ own.trajectory.rotations[rows], axis=0)
    gauge = nearest_rotation(turned)
    theirs = own.centres[rows] @ gauge.T
    scale = _length(centres) / max(_length(theirs), 1e-12)
    return Pair(reference, other, rows,
                Gauge(gauge, np.mean(centres - scale * theirs, axis=0), float(np.log(scale))))


def _length(centres: Floats) -> float:
    return float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())


def _unit_of(scene: ScenePath, known: Metres | None) -> tuple[float, float]:
    """Return the log of the metres in a scene's unit, and its sigma."""
    ways, between = np.linalg.norm(np.diff(scene.centres, axis=0), axis=1), np.diff(scene.seconds)
    if known is not None:
        metres = known.speed(scene.seconds[:-1] + between / 2) * between
        bend = np.linalg.norm(scene.steps(scene.seconds)[0], axis=1) / np.maximum(ways, 1e-12)
        kept = (bend < UNBENT * bend.max()) & (metres > 0)
        sigma = SPEED_SIGMA if kept.sum() >= LEAST_SHARED else BENT_SIGMA
        kept = kept if kept.sum() >= LEAST_SHARED else metres > 0
        if kept.any():
            return float(np.log(metres[kept].sum() / ways[kept].sum())), sigma
    return float(np.log(USUAL_SPEED * between.sum() / max(ways.sum(), 1e-12))), UNKNOWN_UNIT
