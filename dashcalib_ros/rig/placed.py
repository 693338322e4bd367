# SPDX-License-Identifier: Apache-2.0
"""The result: where each camera sits, with a verdict for each degree of freedom."""
from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from dashcalib_ros.arrays import Floats, Mask
from dashcalib_ros.camera.rotation import rotation_matrices, rotation_vectors
from dashcalib_ros.config import RigConfig
from dashcalib_ros.errors import Notice, counted
from dashcalib_ros.judge.calibration import Level
from dashcalib_ros.judge.difference import limit_of
from dashcalib_ros.rig.joint import REACH_M, Matched, Solved, solved
from dashcalib_ros.rig.paths import CameraPaths
from dashcalib_ros.rig.start import LEAST_EXPLAINED, Aligned, Metres, problem_of
from dashcalib_ros.rig.witness import Epipolar

Sight = Literal['accepted', 'weak', 'not visible']
Three = tuple[float, float, float]
Sights = tuple[Sight, Sight, Sight]
NOTHING: Sights = ('not visible', 'not visible', 'not visible')

# times the limit of what is accepted, up to which a degree of freedom is weak
WEAK = 10.0
# of the prior's sigma: where more of it is left, a translation is not visible
PRIOR_LEFT = 0.5
# degrees, m and s by which one stretch may be off beyond all that is known about it: of the real
# pair (benchmark/results/rig.md) by 0.05 degrees about the optical axis, at a sigma of 0.01
STRETCH = np.array([0.05, 0.05, 0.05, 0.02, 0.02, 0.02, 0.0005])
# minimum number of stretches for what is accepted: nothing confirms a single one
LEAST_STRETCHES = 2
# times its sigmas: stretches that differ by more contradict each other
DISAGREE = 3.0
AXES = ('x', 'y', 'z')
# degrees to the left, by words of a camera's name; and how far off it may look: the left one of a
# stereo pair looks ahead
SIDES = {'front': 0.0, 'left': 90.0, 'right': -90.0, 'rear': 180.0, 'back': 180.0}
ELSEWHERE_DEG = 110.0


@dataclass(frozen=True)
class Visible:
    """The verdict of each degree of freedom, in the order of the camera's axes."""

    rotation: Sights = NOTHING
    translation: Sights = NOTHING
    clock: Sight = 'not visible'


@dataclass(frozen=True)
class PlacedCamera:
    """Where a camera of a rig sits: x' = R x + t, from the base's optical axes to its own.

    Optical axes: x to the right, y down, z forward. calibration: the path of its result.
    rotation_deg: the rotation vector of R; its sigmas are of small rotations about this camera's
    axes; None where no drive showed it. translation_m: t; None where no metres are known.
    time_offset_s: to subtract from this camera's stamps for those of the base. verdict: of the
    rotation. reasons: what is not accepted, and what would show it.
    """

    calibration: str
    verdict: Level
    rotation_deg: Three | None = None
    rotation_sigma_deg: Three | None = None
    translation_m: Three | None = None
    translation_sigma_m: Three | None = None
    time_offset_s: float | None = None
    time_sigma_s: float | None = None
    visible: Visible = Visible()
    reasons: tuple[Notice, ...] = ()

    @property
    def rotation(self) -> Floats | None:
        """Return R (3, 3); None where it is not known."""
        if self.rotation_deg is None:
            return None
        return np.asarray(rotation_matrices(np.radians([self.rotation_deg]))[0])


@dataclass(frozen=True)
class RigCalibration:
    """Cameras of one car. base: the name of the first; witness: by the names of two cameras."""

    base: str
    cameras: Mapping[str, PlacedCamera] = field(hash=False)
    witness: Mapping[tuple[str, str], Epipolar] = field(default_factory=dict, hash=False)
    warnings: tuple[Notice, ...] = ()

    @property
    def accepted(self) -> bool:
        """Return whether the place of every camera is accepted."""
        return all(camera.verdict == 'accepted' for camera in self.cameras.values())


@dataclass(frozen=True)
class Alone:
    """What is known about a camera without the others. calibration: the path of its result.

    level: of its lens. start_s: stamp of its first image. scenes: how many may say where it sits.
    """

    calibration: str
    level: Level
    start_s: float
    scenes: int


@dataclass(frozen=True)
class Witnessed:
    """What cameras see together. doubts: what of that contradicts a camera's place.

    matched: rotations that are to be used as observations.
    """

    epipolar: Mapping[tuple[str, str], Epipolar] = field(default_factory=dict)
    doubts: Mapping[str, tuple[Notice, ...]] = field(default_factory=dict)
    matched: tuple[Matched, ...] = ()


def best_base(levels: Mapping[str, Level]) -> str:
    """Return the first camera of those with the best lenses: a refused one keeps no other one."""
    return min(levels, key=lambda name: ('accepted', 'weak', 'refused').index(levels[name]))


def rig_of_paths(alone: Mapping[str, Alone], base: str, turned: Mapping[str, Aligned | None],
                 paths: Mapping[str, CameraPaths], metres: Metres | None, limits: RigConfig,
                 witnessed: Callable[[Solved, bool], Witnessed] = lambda best, use: Witnessed(),
                 car: Floats | None = None) -> RigCalibration:
    """Return where the cameras of one car sit.

    turned: of each but the base, how its turning fits to the base's. metres: None: unknown.
    witnessed: what cameras see together, and with which rotations if they are to be used. car:
    (3, 3) from the base's optical axes to the car's; None: unknown.
    """
    there = {name for name, each in paths.items() if each.scenes}
    kept = {name: each for name, each in turned.items()
            if each is not None and each.found and {base, name} <= there}
    problem = problem_of(paths, base, kept, metres) if kept else None
    best = solved(problem) if problem and problem.pairs else None
    doubts = {name: lens_doubts(name, each.level) for name, each in alone.items()}
    seen = Witnessed()
    if problem is not None and best is not None:
        seen = witnessed(best, True)
        if seen.matched:
            best = solved(replace(problem, matched=seen.matched))
            seen = replace(seen, epipolar=witnessed(best, False).epipolar)
        doubts = {name: (*each, *(apart_doubts(name, best) if name in best.problem.places else ()),
                         *jump_doubts(name, best), *unsettled_doubts(name, best),
                         *seen.doubts.get(name, ()))
                  for name, each in doubts.items()}
    cameras: dict[str, PlacedCamera] = {}
    for name, own in alone.items():
        if name == base:
            cameras[name] = base_camera(own.calibration, doubts[name])
        elif best is None or name not in best.problem.places:
            lacking = next((each for each in (name, base) if not alone[each].scenes), None)
            cameras[name] = not_placed(own.calibration, why_not_aligned(
                name, base, turned.get(name), lacking))
        else:
            cameras[name] = placed(
                name, own.calibration, best, None if metres is None else metres.sigma,
                own.start_s - alone[base].start_s, limits,
                (*doubts[name], *base_doubts(name, base, doubts[base])))
    return RigCalibration(base, cameras, seen.epipolar,
                          () if car is None else misnamed(cameras, car))


def lens_doubts(name: str, level: Level) -> tuple[Notice, ...]:
    """Return why a camera's lens keeps its rotation from being accepted; nothing where none."""
    return () if level == 'accepted' else (Notice(
        'E-RIG-LENS', f'{name}: its lens is {level}, so its rotation is weak at best: drive turns '
        f'in which it sees more'),)


def apart_doubts(name: str, solved: Solved) -> tuple[Notice, ...]:
    """Return that a rig's paths ask for another lens than a camera's own turns allow, or none."""
    return () if solved.lens_distance[name] <= limit_of(
        len(solved.problem.cameras[name].lens_covariance)) else (Notice(
            'E-RIG-LENS-APART', f'{name}: the other cameras ask for another lens than its own '
            f'turns show: check that it was not moved during the drive, or drive more turns'),)


def jump_doubts(name: str, solved: Solved) -> tuple[Notice, ...]:
    """Return that a camera turned against the base within a stretch, or none."""
    return () if name not in solved.jumped else (Notice(
        'E-RIG-JUMP', f'{name}: within a turn it jumps against {solved.problem.base}: check that '
        f'both are fixed to the car, and calibrate the rig from a drive after that'),)


def unsettled_doubts(name: str, solved: Solved) -> tuple[Notice, ...]:
    """Return that the problem has no end, or none."""
    return () if solved.settled else (Notice(
        'E-RIG-UNSETTLED', f'{name}: no place of the cameras fits best: check that all clips are '
        f'of one car, and leave out one camera after another'),)


def base_doubts(name: str, base: str, doubts: Sequence[Notice]) -> tuple[Notice, ...]:
    """Return why the base keeps a camera's rotation against it from being accepted."""
    return () if not doubts else (Notice(
        'E-RIG-BASE', f'{name}: the lens of {base}, against which it is placed, is not accepted: '
        f'choose another --base, or see what {base} needs'),)


def base_camera(calibration: str, doubts: Sequence[Notice] = ()) -> PlacedCamera:
    """Return the base, which sits at its own place. doubts: about its lens."""
    zero: Three = (0.0, 0.0, 0.0)
    sure: Sights = ('accepted', 'accepted', 'accepted')
    return PlacedCamera(calibration, 'weak' if doubts else 'accepted', zero, zero, zero, zero, 0.0,
                        0.0, Visible(sure, sure, 'accepted'), tuple(doubts))


def not_placed(calibration: str, reason: Notice) -> PlacedCamera:
    """Return a camera that the drive shows nothing about."""
    return PlacedCamera(calibration, 'refused', reasons=(reason,))


def why_not_aligned(name: str, base: str, found: Aligned | None, lacking: str | None) -> Notice:
    """Return why a camera's turning does not fit the base's. lacking: which one has no scenes."""
    if lacking:
        return Notice('E-RIG-NO-SCENES', f'{lacking}: no stretch of its drive could be '
                      f'reconstructed: check its pictures, or drive turns past houses')
    if found is None or found.turned == 0.0:
        return Notice('E-RIG-NO-SHARED', f'{name} and {base} have no turn in common: check that '
                      f'both clips are of one drive, and drive two turns that both see')
    if found.other_side and found.explained >= LEAST_EXPLAINED:
        return Notice('E-RIG-OTHER-SIDE', f'{name} turns to the other side when {base} does: '
                      f'check that both clips are of one drive, and turn pictures upright that '
                      f'are upside down or mirrored')
    if found.ambiguous and found.explained >= LEAST_EXPLAINED:
        return Notice('E-RIG-AMBIGUOUS', f'{name} turns as {base} does if its clock is '
                      f'{abs(found.apart_s):.0f} s off, which {counted(found.stretches, "turn")} '
                      f'may show by chance: drive two turns that both see, or record both with '
                      f'one clock')
    return Notice('E-RIG-OTHER-DRIVE', f'{name} does not turn when {base} does: at best '
                  f'{max(100 * found.explained, 0):.0f} % of its turning is explained: check that '
                  f'both clips are of one drive and one car')


def placed(name: str, calibration: str, solved: Solved, scale_sigma: float | None, clock: float,
           limits: RigConfig, doubts: Sequence[Notice] = ()) -> PlacedCamera:
    """Return where a camera sits.

    scale_sigma: the share by which all metres may be off; None: no metres are known. clock: s by
    which its stamps begin after the base's. doubts: what keeps it from being accepted, whatever
    its sigmas.
    """
    place, groups, metric = solved.problem.places[name], solved.own[name], scale_sigma is not None
    sigma = solved.sigma(name)[:7] * np.r_[np.degrees(np.ones(3)), np.ones(4)]
    sigma = np.hypot(sigma, STRETCH / np.sqrt(max(len(groups), 1)))
    sigma[3:6] = np.hypot(sigma[3:6], (scale_sigma or 0.0) * place.translation_m)
    apart = solved.disagreement(name)[:7] > DISAGREE
    most = np.repeat([limits.rotation_deg, limits.translation_m, limits.clock_s], (3, 3, 1))
    alone = len(groups) < LEAST_STRETCHES or bool(doubts)
    sights: list[Sight] = []
    for value, limit, differs in zip(sigma, most, apart, strict=True):
        if value > WEAK * limit:
            sights.append('not visible')
        else:
            sights.append('weak' if value > limit or differs or alone else 'accepted')
    for axis in range(3, 6):
        if sigma[axis] > PRIOR_LEFT * REACH_M:
            sights[axis] = 'not visible'
        elif not metric:
            sights[axis] = 'weak' if sights[axis] == 'accepted' else sights[axis]
    visible = Visible((sights[0], sights[1], sights[2]), (sights[3], sights[4], sights[5]),
                      sights[6])
    verdict: Level = ('accepted' if set(visible.rotation) == {'accepted'} else
                      'refused' if 'not visible' in visible.rotation else 'weak')
    return PlacedCamera(
        calibration, verdict,
        three(np.degrees(rotation_vectors(place.rotation[None])[0])), three(sigma[:3]),
        three(place.translation_m) if metric else None,
        three(sigma[3:6]) if metric else None, place.late_s + clock, float(sigma[6]), visible,
        (*doubts, *_reasons(name, visible, len(groups), apart, sigma, metric)))


def misnamed(cameras: Mapping[str, PlacedCamera], car: Floats) -> tuple[Notice, ...]:
    """Return which cameras look elsewhere than their names say.

    car: (3, 3) from the base's optical axes to the car's: x ahead, y to the left.
    """
    found = []
    for name, camera in cameras.items():
        sides = [SIDES[word] for word in re.split('[-_]', name.lower()) if word in SIDES]
        if len(sides) == 1 and camera.rotation is not None:
            ahead, left, _ = (car @ camera.rotation[2]).tolist()
            yaw = math.degrees(math.atan2(left, ahead))
            if abs(math.remainder(yaw - sides[0], 360)) > ELSEWHERE_DEG:
                found.append(Notice('E-RIG-SIDE', f'{name} looks {abs(yaw):.0f} degrees to the '
                                    f'{"left" if yaw > 0 else "right"} of ahead: check that no '
                                    f'two inputs were exchanged'))
    return tuple(found)


def three(values: Floats) -> Three:
    """Return the three values of an array."""
    x, y, z = values.tolist()
    return x, y, z


def _reasons(name: str, visible: Visible, stretches: int, apart: Mask, sigma: Floats,
             metric: bool) -> tuple[Notice, ...]:
    """Return what is not accepted, and what would show it."""
    found = []
    if stretches < LEAST_STRETCHES:
        found.append(Notice('E-RIG-ONE-STRETCH', f'{name}: one stretch alone shows where it sits, '
                            f'and nothing confirms it: drive more turns'))
    if apart[:3].any():
        found.append(Notice('E-RIG-DISAGREE', f'{name}: the stretches differ by more than their '
                            f'sigmas: check that the camera was not moved during the drive'))
    if lacking := _lacking(visible.rotation):
        found.append(Notice('E-RIG-ROTATION', f'{name}: its rotation about {lacking} is not '
                            f'visible on this drive: drive more turns, to the left and to the '
                            f'right'))
    if lacking := _lacking(visible.translation):
        found.append(Notice('E-RIG-TRANSLATION', f'{name}: its translation along {lacking} is not '
                            f'visible on this drive: a ramp or a kerb shows the height between '
                            f'two cameras, turns show the rest'))
    if not metric:
        found.append(Notice('E-RIG-NO-METRES', f'{name}: no metres are known, so it has no '
                            f'translation: add a speed (--motion), or the '
                            f'height of the base above the road (--known height=1.45±0.03)'))
    if visible.clock == 'not visible':
        found.append(Notice('E-RIG-CLOCK', f'{name}: its clock is known to {sigma[6]:.3f} s only: '
                            f'drive sharper turns'))
    return tuple(found)


def _lacking(sights: Sights) -> str:
    """Return the axes along which nothing is visible."""
    return ', '.join(axis for axis, sight in zip(AXES, sights, strict=True)
                     if sight == 'not visible')
