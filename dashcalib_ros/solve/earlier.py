"""Turns of earlier drives count only as far as those of this drive confirm them.

Between two drives the camera may have been exchanged, zoomed or turned. So both sets of turns say
what camera they see. Where they contradict each other, those of earlier drives are left out. Else
the camera of this drive may still differ from that of the earlier ones, by what its own turns
cannot tell: that is added to the covariance.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.mapping import as_model, sensitivity
from dashcalib_ros.reconstruct.heading import roll_deg
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.solve.solution import Solution

# of fx, and as much over the picture in every other parameter: by how much the cameras of two
# drives may differ before anything is known of it, as two units of one make do
OTHER_CAMERA = 0.02
# sigmas; beyond it two sets of turns are of two cameras. One in 370 is so by chance
CONTRADICTION = 3.0
# of OTHER_CAMERA; where both sets are farther apart, the turns of this drive are solved alone, too
ASKED = 0.25
# degrees between the uprights of two sets of turns: pictures are turned by 90 or 180
OTHER_UPRIGHT_DEG = 45.0


@dataclass(frozen=True)
class Comparison:
    """What the turns of this drive say of the camera of earlier drives.

    sigmas: by how many standard deviations both differ. apart_px: RMS of the difference over the
    picture. doubt: (n, n) covariance of the joint camera from what may differ between the drives.
    """

    sigmas: float
    apart_px: float
    doubt: Floats


def solve_with_earlier(scenes: Sequence[Scene], solve: Callable[[Sequence[Scene]],
                                                                Solution | None]
                       ) -> Solution | None:
    """Solve turns of this drive and of earlier ones; without the latter if they are contradicted.

    Where all turns are of this drive, or none is, it is what solve() makes of them.
    """
    joint = solve(scenes)
    own = [scene for scene in scenes if scene.turn.of_this_drive]
    if joint is None or not 0 < len(own) < len(scenes):
        return joint
    if not _scenes_of(joint, True):
        return solve(own)
    if not _scenes_of(joint, False):
        return joint
    found = _compared(joint)
    if _turned(joint) or found.sigmas > CONTRADICTION:
        return solve(own)
    if found.apart_px > ASKED * OTHER_CAMERA * joint.camera.fx * _by_unit(joint.camera)[0]:
        # far from the solution the quadratic says too little: both sets make its noise larger
        alone = solve(own)
        if alone is not None and _apart_px(joint.camera, alone.camera) > (
                CONTRADICTION * alone.picture.rms):
            return alone
    return with_doubt(joint, found.doubt)


def _turned(joint: Solution) -> bool:
    apart = abs(roll_deg(_scenes_of(joint, True)) - roll_deg(_scenes_of(joint, False))) % 360
    return min(apart, 360 - apart) > OTHER_UPRIGHT_DEG


def _apart_px(camera: Camera, other: Camera) -> float:
    """Return how far two cameras are apart over the picture, the best rotation removed."""
    if type(camera) is not type(other):
        camera = as_model(camera, type(other))
    moves, _ = sensitivity(other)
    return _rms(moves @ (camera.params - other.params))


def _by_unit(camera: Camera) -> Floats:
    """Return (n,) how far a unit of each parameter moves the picture, px RMS."""
    return np.array([_rms(each) for each in np.moveaxis(sensitivity(camera)[0], 2, 0)])


def _rms(moves: Floats) -> float:
    return float(np.sqrt(np.mean(np.sum(moves**2, axis=-1))))


def with_doubt(solution: Solution, doubt: Floats) -> Solution:
    """Return the solution with more covariance (n, n), or less, over the picture too."""
    moves, _ = sensitivity(solution.camera.widened())
    moves = moves[:, :, :len(doubt)]
    more = np.einsum('mai,ij,maj->m', moves, doubt, moves)
    drawn = solution.sigma_map
    before = 0.0 if solution.doubt is None else solution.doubt
    return replace(solution, covariance=solution.covariance + doubt, doubt=before + doubt,
                   sigma_map=replace(drawn, sigma=np.sqrt(np.maximum(drawn.sigma**2 + more, 0))))


def _scenes_of(solution: Solution, this_drive: bool) -> list[Scene]:
    return [scene for scene in solution.scenes if scene.turn.of_this_drive == this_drive]


def _compared(solution: Solution) -> Comparison:
    """Compare the turns of this drive with those of earlier ones; there is one of each at least.

    The difference d of both cameras is known with the covariance S. Before that it is normal with
    the covariance T, so then it has the mean T (T + S)^-1 d and the covariance T - T (T + S)^-1 T.
    The joint camera takes over the share of it that the earlier turns have in the information.
    """
    from scipy import special
    known = solution.known
    own, earlier = (known.of(n for n, scene in enumerate(solution.scenes)
                             if scene.turn.of_this_drive == this_drive)
                    for this_drive in (True, False))
    by_unit, block = _by_unit(solution.camera), np.ix_(known.own, known.own)
    before = np.diag((OTHER_CAMERA * solution.camera.fx * by_unit[0] / by_unit)**2)
    difference = known.offset_of(own) - known.offset_of(earlier)
    covariance = own.covariance[block] + earlier.covariance[block]
    distance = float(difference @ np.linalg.solve(covariance, difference))
    gain = before @ np.linalg.inv(before + covariance)
    mean = gain @ difference
    share = np.linalg.solve(known.with_prior(known.each(known.own)).hessian,
                            earlier.sum(known.own).at_noise(known.noise).hessian)
    doubt = share @ (np.outer(mean, mean) + before - gain @ before) @ share.T
    moves, _ = sensitivity(solution.camera)
    return Comparison(float(-special.ndtri(special.chdtrc(len(by_unit), distance) / 2)),
                      _rms(moves @ difference), np.asarray(doubt + doubt.T) / 2)
