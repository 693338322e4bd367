# SPDX-License-Identifier: Apache-2.0
"""Two cameras of one car: how one is turned against the other, and whether they saw one drive.

Each mounting is against the car's direction of travel and its vertical, which both cameras share:
what is common to both (a crowned road) does not matter here. That both are of one drive, their
turns show: at the same time, to the same side.
"""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from dashcalib_ros.errors import InputError
from dashcalib_ros.judge.calibration import CalibrationData, Mount

# s between the middles of one turn as two cameras see it: another lens sees other pictures of it
SAME_TURN_S = 2.0
# of the larger angle: one turn may begin and end elsewhere for another camera, but a turn to the
# other side differs by all of it, and more
SAME_ANGLE = 0.5


@dataclass(frozen=True)
class SharedTurn:
    """One turn that both cameras took. a_right_deg, b_right_deg: by how much, to the right."""

    a_stamp_s: float
    b_stamp_s: float
    a_right_deg: float
    b_right_deg: float

    @property
    def agrees(self) -> bool:
        """Return whether the car turned to the same side, and about as far."""
        return abs(self.a_right_deg - self.b_right_deg) < SAME_ANGLE * max(
            abs(self.a_right_deg), abs(self.b_right_deg))


@dataclass(frozen=True)
class Rig:
    """Camera B against camera A of the same car.

    rotation: (3, 3) row by row, from B's optical frame to A's; an unknown roll counts as 0.
    angles: B's mounting minus A's and the sigma, degrees, by the names in ANGLES; without those
    that one of both does not know. turns: that both cameras took.
    """

    rotation: tuple[tuple[float, ...], ...]
    angles: Mapping[str, tuple[float, float]]
    turns: tuple[SharedTurn, ...]

    @property
    def agrees(self) -> bool | None:
        """Return whether all turns of both agree; None where they have none in common."""
        return all(turn.agrees for turn in self.turns) if self.turns else None


def rig_of(a: CalibrationData, b: CalibrationData) -> Rig:
    """Return how B is turned against A. Raises InputError where a mounting is not known."""
    mount, other = _mount(a, 'first'), _mount(b, 'second')
    return Rig(tuple(map(tuple, (mount.rotation.T @ other.rotation).tolist())),
               other.apart(mount), _shared(a, b))


def _mount(calibration: CalibrationData, which: str) -> Mount:
    if calibration.mount is None:
        raise InputError('E-RIG-NO-MOUNTING',
                         f'the {which} calibration does not say how its camera sits on the car; '
                         f'calibrate a drive that goes straight on, too, without --no-mount')
    return calibration.mount


def _shared(a: CalibrationData, b: CalibrationData) -> tuple[SharedTurn, ...]:
    """Return the turns that both took, each of A with the nearest of B in time."""
    found = []
    for turn in a.turns:
        near = min((each for each in b.turns if each.right_deg is not None), default=None,
                   key=lambda each: abs(each.stamp_s - turn.stamp_s))
        if (near is not None and near.right_deg is not None and turn.right_deg is not None
                and abs(near.stamp_s - turn.stamp_s) < SAME_TURN_S):
            found.append(SharedTurn(turn.stamp_s, near.stamp_s, turn.right_deg, near.right_deg))
    return tuple(found)
