# SPDX-License-Identifier: Apache-2.0
"""A rig of two drives: which camera was moved since, or exchanged with another one.

No camera is above suspicion, the base neither: two cameras sat still where they sit to each other
as before. Those of the largest group in which all did so are still, and the others were moved.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera.rotation import rotation_vectors
from dashcalib_ros.judge.difference import Answer, distance, limit_of
from dashcalib_ros.rig.placed import PlacedCamera, RigCalibration, Three, three

# degrees and m; a smaller move is none, whatever the sigmas are
LEAST_DEG, LEAST_M = 0.2, 0.1
# degrees; drives that would not show such a move cannot tell
SHOWN_DEG = 1.0
# degrees; of a place that is known perfectly
LEAST_SIGMA = 1e-3


@dataclass(frozen=True)
class Move:
    """By how much a camera moved against another one, with sigmas, in its own axes.

    translation_m: None without metres in both drives. moved: whether that is more than chance;
    perhaps: it, or the other one.
    """

    rotation_deg: Three
    rotation_sigma_deg: Three
    translation_m: Three | None = None
    translation_sigma_m: Three | None = None
    moved: bool = False
    perhaps: bool = False

    @property
    def still(self) -> bool:
        """Return whether both sit to each other as before, as far as the sigmas tell."""
        return not any(
            value is not None and sigma is not None and np.linalg.norm(value) > least
            and distance(np.array(value), np.diag(np.square(sigma))) > limit_of(3)
            for value, sigma, least in (
                (self.rotation_deg, self.rotation_sigma_deg, LEAST_DEG),
                (self.translation_m, self.translation_sigma_m, LEAST_M)))


@dataclass(frozen=True)
class RigChange:
    """What is another in a rig than in an earlier one.

    cameras: that both show, against one that sat still. exchanged: the names of two cameras that
    sit where the other one sat. unknown: names of which one of both shows no place.
    """

    cameras: Mapping[str, Move] = field(hash=False)
    exchanged: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()

    @property
    def answer(self) -> Answer:
        """Return wrong where a camera was moved, right where none was, or cannot tell."""
        if self.exchanged or any(each.moved or each.perhaps for each in self.cameras.values()):
            return 'wrong'
        sure = self.cameras and not self.unknown and all(
            limit_of(3) * max(each.rotation_sigma_deg) < SHOWN_DEG
            for each in self.cameras.values())
        return 'right' if sure else 'cannot tell'


def changes(now: RigCalibration, before: RigCalibration) -> RigChange:
    """Return which cameras of a rig were moved since an earlier one."""
    names = [name for name, camera in now.cameras.items() if camera.rotation is not None
             and name in before.cameras and before.cameras[name].rotation is not None]
    unknown = tuple(name for name in {**now.cameras, **before.cameras} if name not in names)
    if len(names) < 2:
        return RigChange({}, (), unknown)
    # nothing was exchanged, unless that leaves more of them still
    exchanged: tuple[str, ...] = ()
    groups = _still(now, before, names, exchanged)
    for pair in combinations(names, 2):
        found = _still(now, before, names, pair)
        if len(found[0]) > len(groups[0]):
            exchanged, groups = pair, found
    cameras = {}
    for name in names:
        other = next(each for each in (*sorted(groups[0], key=now.base.__ne__), *names)
                     if each != name)
        inside = [name in group for group in groups]
        cameras[name] = _move(now, before, other, name, exchanged, not any(inside),
                              any(inside) and not all(inside))
    return RigChange(cameras, exchanged, unknown)


def _still(now: RigCalibration, before: RigCalibration, names: Sequence[str],
           exchanged: tuple[str, ...]) -> list[tuple[str, ...]]:
    """Return the largest groups of cameras that sit to each other as before."""
    still = {pair for pair in combinations(names, 2)
             if _move(now, before, *pair, exchanged).still}
    for count in range(len(names), 1, -1):
        found = [group for group in combinations(names, count)
                 if still.issuperset(combinations(group, 2))]
        if found:
            return found
    return [(name,) for name in names]


def _move(now: RigCalibration, before: RigCalibration, a: str, b: str,
          exchanged: tuple[str, ...], moved: bool = False, perhaps: bool = False) -> Move:
    """Return how camera b moved against camera a."""
    other = dict(zip(exchanged, exchanged[::-1], strict=True))
    new = _between(now.cameras[a], now.cameras[b])
    old = _between(before.cameras[other.get(a, a)], before.cameras[other.get(b, b)])
    rotation = np.degrees(rotation_vectors((new[0] @ old[0].T)[None])[0])
    shift, sigma = new[2] - old[2], np.hypot(new[3], old[3])
    metric = bool(np.isfinite(shift).all())
    return Move(three(rotation), three(np.hypot(np.hypot(new[1], old[1]), LEAST_SIGMA)),
                three(shift) if metric else None, three(sigma) if metric else None,
                moved, perhaps)


def _between(a: PlacedCamera, b: PlacedCamera) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the rotation (3, 3) from a's axes to b's, its sigmas, the translation, and its."""
    assert a.rotation is not None and b.rotation is not None
    across = b.rotation @ a.rotation.T
    turn, its_turn, shift, its_shift, move, its_move = (
        np.full(3, np.nan) if each is None else np.array(each) for each in (
            b.rotation_sigma_deg, a.rotation_sigma_deg, b.translation_m, a.translation_m,
            b.translation_sigma_m, a.translation_sigma_m))
    return (across, np.sqrt(turn**2 + across**2 @ its_turn**2), shift - across @ its_shift,
            np.sqrt(move**2 + across**2 @ its_move**2))
