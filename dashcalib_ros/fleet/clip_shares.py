"""What each clip of a camera gave to its calibration, and which clips are of another camera."""
from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dashcalib_ros.config import VerdictConfig
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.judge.agreement import turns_of_another_camera
from dashcalib_ros.reconstruct.scene_file import StoredTurn
from dashcalib_ros.solve.solution import Solution

# a clip whose own fx is farther off that of most, in sigmas and in shares of it, is of another
# camera; on one real drive gentle bends differ by 3 % from the sharp turn
OTHER_FOCAL, OTHER_FOCAL_SHARE = 4.0, 0.05


@dataclass(frozen=True)
class ClipShare:
    """What a clip gave to its camera's calibration.

    used: turns in the adjustment. left_out: why none is, '' otherwise. fx, fx_sigma: what its
    turns alone say, in px of the input, linearised at the camera's solution; None where unknown.
    """

    used: int = 0
    left_out: str = ''
    fx: float | None = None
    fx_sigma: float | None = None


@dataclass(frozen=True)
class ClipTurn:
    """A turn of one of the clips. stored: with an identity that is unique in the camera."""

    clip: str
    stored: StoredTurn


def contradicting(solution: Solution | None, turns: Mapping[TurnId, ClipTurn], px: float,
                  config: VerdictConfig) -> dict[str, str]:
    """Return the clips, less than half of all, that are of another camera, and why.

    Two things tell: the cost of a clip's turns, and what fx they alone would have.
    """
    if solution is None:
        return {}
    of_another = turns_of_another_camera(solution.misfits, config)
    used = Counter(turns[key].clip for key in solution.misfits)
    against = Counter(turns[key].clip for key in of_another)
    found = {clip: f'fits another camera: its turns cost {worst:.1f} times as much with this one'
             for clip, count in sorted(against.items()) if 2 * count >= used[clip]
             for worst in [max(solution.misfits[key] for key in of_another
                               if turns[key].clip == clip)]}
    found.update(_other_focal(shares_of(solution, turns, px)))
    # where half of them differ, nobody knows which are right: the verdict is weak, and says so
    return found if 2 * len(found) < len(used) else {}


def _other_focal(shares: Mapping[str, ClipShare]) -> dict[str, str]:
    """Return the clips whose own fx is clearly off the median of all, each counted about once."""
    known = [(clip, share.fx, share.fx_sigma) for clip, share in sorted(shares.items())
             if share.fx and share.fx_sigma]
    if len(known) < 3:
        return {}
    fx, sigma = (np.array([each[place] for each in known], float) for place in (1, 2))
    tolerance = OTHER_FOCAL_SHARE * fx
    weight = 1 / (sigma**2 + tolerance**2)
    order = np.argsort(fx, kind='stable')
    passed = np.cumsum(weight[order])
    middle = float(fx[order][np.searchsorted(passed, passed[-1] / 2)])
    limit = np.maximum(tolerance, OTHER_FOCAL * sigma)
    return {known[n][0]: f'fits another camera: its turns alone have an fx of {fx[n]:.0f} px, '
                         f'those of most clips {middle:.0f} px'
            for n in np.flatnonzero(np.abs(fx - middle) > limit)}


def shares_of(solution: Solution | None, turns: Mapping[TurnId, ClipTurn], px: float
            ) -> dict[str, ClipShare]:
    """Return what each clip gave, and what its turns alone say of fx."""
    if solution is None:
        return {}
    known, found = solution.known, {}
    clips = {turns[scene.turn].clip for scene in solution.scenes}
    for clip in sorted(clips):
        own = known.of(n for n, scene in enumerate(solution.scenes)
                       if turns[scene.turn].clip == clip)
        cost = own.with_prior([own.sum(known.own).at_noise(known.noise)])
        # observations of a track share its errors
        variance = max(float(cost.covariance[0, 0]), float(cost.covariance_by_track[0, 0]))
        offset = float((cost.covariance @ cost.score)[0])
        found[clip] = ClipShare(used=len(own.turns), fx=px * (solution.camera.fx + offset),
                                fx_sigma=px * float(np.sqrt(variance)))
    return found
