# SPDX-License-Identifier: Apache-2.0
"""Whether the turns agree on one camera, and what each of them, and one more, knows about fx."""
from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, replace

import numpy as np

from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.input.motion import SensorStream
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.robust import weighted_mean
from dashcalib_ros.solve.solution import Solution

# times a turn's cost with a camera of its own; sound turns of recorded drives have 0.5 to 1.1, a
# sharp one of KITTI 03 with a focal length 5 % off 2.2 to 2.7, a gentle one 1.0
MAX_MISFIT = 2.0
# why turns do not count
CONTRADICTS = 'the camera of the other turns does not explain it'
OTHER_CAMERA = 'the turns of this drive are of another camera'
STOOD = 'according to its speed the car stood: other things turned, or the camera alone'


def turns_that_stood(scenes: Sequence[Scene], motion: SensorStream | None, start_s: float
                     ) -> dict[TurnId, str]:
    """Return the turns of this drive during which the car stood, as its speed says.

    start_s: stamp of the drive's first image.
    """
    stream = (motion or SensorStream()).since(start_s)
    return {scene.turn: STOOD for scene in scenes if scene.turn.of_this_drive
            and stream.stood(*(scene.tracks.stamps_ns[[0, -1]] / 1e9 - start_s))}


# s between two stretches, and degrees of the sharper one's yaw: both are one bend where they turn
# the same way. Of 98 degrees on a ramp the last 9.5 agreed with a focal length 4 % short
BEND_GAP_S, ONE_BEND_DEG = 1.0, 30.0


def separate_bends(scenes: Sequence[Scene]) -> int:
    """Return how many bends there are: the end of a sharp one does not confirm its beginning."""
    ordered = sorted(scenes, key=lambda scene: (scene.turn.of_this_drive, scene.turn.clip,
                                                int(scene.tracks.stamps_ns[0])))

    def goes_on(scene: Scene, after: Scene) -> bool:
        begins_ns, ends_ns = int(after.tracks.stamps_ns[0]), int(scene.tracks.stamps_ns[-1])
        return (scene.turn.of_this_drive == after.turn.of_this_drive
                and scene.turn.clip == after.turn.clip
                and int(scene.tracks.stamps_ns[0]) < begins_ns < ends_ns + 1e9 * BEND_GAP_S
                and scene.right_deg * after.right_deg > 0
                and max(scene.yaw_deg, after.yaw_deg) >= ONE_BEND_DEG)

    return len(ordered) - sum(map(goes_on, ordered, ordered[1:]))


def turns_of_another_camera(misfits: Mapping[TurnId, float]) -> set[TurnId]:
    """Return the turns that their own camera explains far better than the shared one.

    The robust loss gives such turns so little weight that they cause no scatter between turns.
    """
    return {turn for turn, misfit in misfits.items() if not misfit <= MAX_MISFIT}


def turns_of_earlier_cameras(scenes: Sequence[Scene], solution: Solution | None
                             ) -> dict[TurnId, str]:
    """Return the turns of earlier drives that solve() left out for those of this one, and why."""
    if solution is None:
        return {}
    return {scene.turn: OTHER_CAMERA for scene in scenes
            if not scene.turn.of_this_drive and scene.turn not in solution.misfits}


def contradicting_turns(scenes: Sequence[Scene], solution: Solution | None
                        ) -> dict[TurnId, str]:
    """Return the turns that no common camera explains, and why they do not count any more.

    Turns of another camera count on: without them the next verdict would not mention that the
    camera changed.
    """
    keep = set(turns_of_earlier_cameras(scenes, solution))
    if solution is not None:
        keep |= {scene.turn for scene in solution.scenes}
        keep |= turns_of_another_camera(solution.misfits)
    return {scene.turn: CONTRADICTS for scene in scenes if scene.turn not in keep}


def outdated(turns: Set[TurnId], of_another: Set[TurnId]) -> set[TurnId]:
    """Return the turns that are not of the present camera, judged by this drive's newest two.

    of_another: those of the turns that fit another camera. If the newest turn is not among them,
    they are outdated. If the newest two are, the camera has changed and all others are outdated.
    If only the newest is, nothing is outdated: its misfit may come from traffic.
    """
    # the stored turns of earlier drives have no order in time
    newest = sorted(turn for turn in turns if turn.of_this_drive)[-2:]
    if newest and newest[-1] not in of_another:
        return set(of_another)
    return set(turns - of_another) if len(newest) == 2 and of_another >= set(newest) else set()


def focal_disagreement(solution: Solution, beyond_sigma: bool = False) -> float:
    """Return the weighted scatter between the turns' own fx, relative to fx.

    beyond_sigma: without what their own sigmas explain.
    """
    if len(solution.scenes) < 2:
        return 0.0
    own = list(focal_of_turns(solution).values())
    mean = weighted_mean(np.array([turn.fx for turn in own]),
                         np.array([turn.sigma**2 for turn in own]))
    squares = max(0.0, mean.squares - (mean.count - 1)) if beyond_sigma else mean.squares
    return float(np.sqrt(squares * mean.variance) / solution.camera.fx)


def leverages(solution: Solution) -> dict[TurnId, float]:
    """Return each turn's share in the information about fx; the shares sum to 1."""
    known = {turn: found.sigma**-2 for turn, found in focal_of_turns(solution).items()}
    return {turn: own / sum(known.values()) for turn, own in known.items()}


@dataclass(frozen=True)
class FocalEstimate:
    """fx and its standard deviation, px of the scenes' images."""

    fx: float
    sigma: float


def focal_of_turns(solution: Solution) -> dict[TurnId, FocalEstimate]:
    """Return what each turn says about fx alone, linearised at the common result.

    Sigma cannot hold how much turns differ: one turn does not show that.
    """
    return {scene.turn: focal_of(solution, [n]) for n, scene in enumerate(solution.scenes)}


def focal_of(solution: Solution, places: Iterable[int]) -> FocalEstimate:
    """Return what some of the turns say about fx, where only their noise makes turns differ."""
    some = solution.posterior.alike.of(places)
    return FocalEstimate(solution.camera.fx + float(solution.offset_of(some)[0]),
                         float(np.sqrt(solution.carried(some.covariance)[0, 0])))


def sigma_by_count(solution: Solution) -> list[float]:
    """Return the sigma of fx with the first turn, with the first two, ... and with all, px."""
    return [sigma_of(solution, range(count))
            for count in range(1, len(solution.posterior.turns) + 1)]


def sigma_of(solution: Solution, places: Iterable[int]) -> float:
    """Return the sigma of fx, px, that some of the turns would leave."""
    some = solution.posterior.of(places)
    return float(np.sqrt(solution.carried(some.covariance)[0, 0]))


# of fx; a larger sigma helps nobody to decide
SHOWN = 0.2


def next_turn(solution: Solution) -> str:
    """Return what one more turn would bring, in words; '' where that is not known."""
    # how much two turns differ is chance; so for a single one it is what two more bring
    more = 1 if len(solution.scenes) > 1 else 2
    sigma = with_right_angles(solution, more)
    if not sigma < SHOWN:
        return ''
    # one digit is all that is known
    turns = ('one more right-angle turn', 'two more right-angle turns')[more - 1]
    return f'{turns}: fx known to about {float(f"{100 * sigma:.1g}"):g} %'


def with_right_angles(solution: Solution, more: int) -> float:
    """Return the sigma of fx, of fx, that a calibration with more right angles would state.

    Each is taken to know as much as the turn here that knows most, and to agree with the others.
    """
    known, shares = solution.posterior, leverages(solution)
    best = known.turns[max(range(len(known.turns)),
                           key=lambda n: shares[solution.scenes[n].turn])]
    another = replace(best, score=np.zeros_like(best.score))
    later = replace(known, turns=(*known.turns, *[another] * more),
                    earlier=np.append(known.earlier, [False] * more))
    return float(np.sqrt(solution.carried(later.covariance)[0, 0]) / solution.camera.fx)
