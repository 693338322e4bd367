# SPDX-License-Identifier: Apache-2.0
"""Scenes -> one camera: a start for each kind of lens, then one problem of all blocks."""
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import AUTO, PINHOLE, Camera, searched
from dashcalib_ros.config import Config
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.input.motion import Samples
from dashcalib_ros.problem.blocks import (
    FOCAL_BOUND,
    Block,
    Drift,
    Readout,
    Shift,
    bounds_of,
    imaging_with,
    lens_like,
)
from dashcalib_ros.problem.stamps import timed_by_path
from dashcalib_ros.reconstruct.chain import CHAIN_ERROR
from dashcalib_ros.reconstruct.heading import roll_deg
from dashcalib_ros.reconstruct.scene import BEND_DEG, Profile, Scene, truncated_cost
from dashcalib_ros.solve.evidence import (
    HIDDEN_DEG,
    LARGE_FIELD,
    SHARP_DEG,
    Candidate,
    FixedCameraTest,
    chosen_kind,
    costs_of,
    drifting,
    field_size,
    fixed_camera_tests,
    moves,
    shift_size,
)
from dashcalib_ros.solve.optimise import (
    FIRST_TRACKS,
    Estimate,
    optimised,
    other_shape_of_pixels,
)
from dashcalib_ros.solve.solution import FocalDrift, Solution
from dashcalib_ros.solve.spread import Posterior
from dashcalib_ros.solve.start import (
    adapted_to,
    explained_by,
    kinds_of_lenses,
    misfits,
    nearest_start,
    profile_around,
    summed,
    with_better_poses,
    with_poses_of,
)
from dashcalib_ros.solve.written import Written, closest, sees_as_pinhole, written

Progress = Callable[[str, float], None]

# px: least scales of the loss with a part of the tracks, and steps with each. A windscreen's 2 px
# would be cut off by the usual one, which is the last
LOSSES = ((2.0, 4), (1.0, 2), (0.5, 2), (0.0, 5))
# the same with one focal length, a centred lens, its first two coefficients, and a readout
FIRST_LOSSES = ((2.0, 5), (1.0, 3))
FIRST_REACH, FIRST_FREE = 0.35, (0, 1, 4, 5)
# times the focal length of the profiles, where gentle bends begin: they have several optima
STARTS = (1.0, 0.7, 1.4, 2.0)
# gain of a step, in units of the noise, that ends the search with a part of the tracks
NEAR = 0.5
# with all tracks: steps after each triangulation
LAST_STEPS = (3, 3)
# more rounds of steps where the focal length changes: the first leaves 6 % of a growth by 5 %
DRIFT_ROUNDS = 3
# nats of evidence that earlier drives had another camera: three standard deviations
CONTRADICTION = 4.5
# of fx: what gentle bends and straight stretches have in common beyond the errors of their tracks,
# with fixed pictures; and where pictures may be shifted, with a bend of 20 degrees. The less a
# bend turns, the more of it a shift makes up for (benchmark/results/without_turns.md)
GENTLE, GENTLE_SHIFTED = 0.008, 0.035
# degrees: no stretch counts as straighter
LEAST_BEND_DEG = 1.0
# degrees between the uprights of two sets of turns: pictures are turned by 90 or 180
OTHER_UPRIGHT_DEG = 45.0


@dataclass(frozen=True)
class _Begun:
    """A kind of lens with a part of the tracks, and the sum of its turns' focal profiles."""

    found: Estimate
    profile: Profile


def solve(scenes: Sequence[Scene], config: Config, temperature: Samples | None = None,
          progress: Progress = lambda stage, done: None) -> Solution | None:
    """Adjust all scenes with one shared camera; None if it explains none, or none determines it.

    scenes: at least one, each as its turn was reconstructed. Turns of earlier drives that this
    drive's turns contradict are left out.
    """
    scenes, times = timed_by_path(scenes)
    try:
        found = _solved(scenes, config, progress, temperature)
        if found is None:
            return None
        step_ns = None if found.drift is None else found.drift.step_ns
        return replace(found, times=times, parts=() if step_ns is None else tuple(
            _part(scenes, config, step_ns, later) for later in (False, True)))
    except np.linalg.LinAlgError:
        # nothing limits a direction of the parameters: pictures that slide past show no depth
        return None


def _part(scenes: Sequence[Scene], config: Config, step_ns: int, later: bool) -> Solution | None:
    """Return the solution of this drive's turns before a step, or of those later."""
    kept = [scene for scene in scenes if scene.turn.of_this_drive
            and (int(scene.tracks.stamps_ns[0]) >= step_ns) == later]
    with suppress(np.linalg.LinAlgError):
        return _solved(kept, config, lambda stage, done: None)
    return None


def _of_another_drive(found: Estimate) -> bool:
    """Return whether the turns of earlier drives contradict those of this one."""
    own = [scene.turn.of_this_drive for scene in found.scenes]
    if all(own) or not any(own):
        return False
    old, new = ([scene for scene in found.scenes if scene.turn.of_this_drive == this]
                for this in (False, True))
    before, now = roll_deg(old), roll_deg(new)
    # gentle turns do not tell
    apart = 0.0 if before is None or now is None else abs(before - now) % 360
    return (min(apart, 360 - apart) > OTHER_UPRIGHT_DEG
            or _posterior(found).of_another_drive > CONTRADICTION)


def _solved(per_turn: Sequence[Scene], config: Config, progress: Progress,
            temperature: Samples | None = None) -> Solution | None:
    begun = []
    for kind in kinds_of_lenses(per_turn):
        # one kind may be so wrong that nothing determines it
        with suppress(np.linalg.LinAlgError):
            found = _begun(kind, per_turn, config, progress)
            begun += [] if found is None else [found]
    if not begun:
        return None
    start, tried = _chosen(begun, config)
    best = start.found
    progress('adjusting all parameters', 0.5)
    measured = {scene.turn: scene for scene in per_turn}
    best = _with_all_tracks(best, measured, config)
    if not best.scenes:
        return None
    best = _finished(best)
    # now, as shifts of pictures may make up for another lens
    if _of_another_drive(best):
        return _solved([scene for scene in per_turn if scene.turn.of_this_drive], config, progress,
                       temperature)
    if loose := _perhaps_shifted(best):
        progress('testing whether the picture moves', 0.0)
        best = _with(best, Shift(only=loose))
    steady = best
    drift, wanders = (None, 0.0) if best.moves else drifting(best, temperature)
    if drift is not None:
        best = _with(best, drift)
        for _ in range(DRIFT_ROUNDS):
            best = _finished(best)
    unlike = misfits(per_turn, best.seen_by_lens, best.camera, config.scene.error_px)
    tests = fixed_camera_tests(best)
    if best is not steady and moves(tests):
        # what a stabiliser does may look like a drift, too
        best, tests = steady, fixed_camera_tests(steady)
    if config.intrinsics.crop_rounds and moves(tests):
        progress('testing whether the picture moves', 0.0)
        best = _steadied(best, measured, config)
        tests = fixed_camera_tests(best)
    elif config.intrinsics.crop_rounds and not loose and (size := shift_size(best)):
        best = _with(best, Shift(sigma=size))
        tests = fixed_camera_tests(best)
    return _solution(best, unlike, start.profile, tried, tests, wanders, progress)


def _begun(kind: str, per_turn: Sequence[Scene], config: Config, progress: Progress
           ) -> _Begun | None:
    """Return a kind of lens with a part of the tracks; None where it explains no turn.

    First with one focal length and the centre fixed (paper, 3.2), then with all blocks.
    """
    starts = [scene.starts[kind] for scene in per_turn if kind in scene.starts]
    profile = summed([start.profile for start in starts])
    camera = nearest_start([start.camera for start in starts], profile)
    progress('adjusting one focal length', 0.0)
    sharp = any(scene.yaw_deg >= SHARP_DEG for scene in per_turn)
    tried = [each for start in ((camera,) if sharp else [
        camera.with_focal(camera.fx * ratio) for ratio in STARTS])
        if (each := _with_one_focal_length(start, per_turn, config)) is not None]
    if not tried:
        return None
    found, measured = min(tried, key=lambda each: _explains(each[0]))
    kept = explained_by(found.retriangulated().scenes, measured, found.camera, config)
    if not kept:
        return None
    progress('adjusting all parameters', 0.0)
    readout = found.imaging.blocks[Readout.name]
    found = _start(found.camera, tuple(kept), found.camera, config).having(readout)
    near = _narrowed(found.with_tracks(FIRST_TRACKS))
    return None if near is None else _Begun(near, profile)


def _with_one_focal_length(camera: Camera, per_turn: Sequence[Scene], config: Config
                           ) -> tuple[Estimate, dict[TurnId, Scene]] | None:
    """Return the optimum with one focal length near a camera, and the turns as adapted to that."""
    measured = {scene.turn: adapted_to(scene, camera, config) for scene in per_turn}
    found = _start(camera, tuple(measured.values()), camera, config, FIRST_REACH)
    lens = found.imaging.lens
    found = found.having(replace(lens, directions=np.eye(len(lens.value))[:, FIRST_FREE]),
                         replace(found.imaging.smooth, held=True))
    for least_px, steps in FIRST_LOSSES:
        found = found.with_tracks(FIRST_TRACKS).retriangulated(2 * least_px)
        if not found.scenes:
            return None
        found = optimised(found, least_px, steps, NEAR, choose=False)
    return found, measured


def _explains(found: Estimate) -> float:
    """Return the mean truncated cost of the turns, px^2; what is not explained counts most."""
    limit_px = 2 * FIRST_LOSSES[-1][0]
    return float(np.mean([truncated_cost(scene, found.camera, limit_px)
                          for scene in found.retriangulated(limit_px).seen_by_lens]))


def _start(camera: Camera, scenes: tuple[Scene, ...], centred: Camera, config: Config,
           focal_reach: float = FOCAL_BOUND) -> Estimate:
    wide = type(camera.widened())
    centred = wide.centred(camera.image_size, centred.fx, *centred.params[4:6])
    found = Estimate(imaging_with(camera.widened(), scenes), scenes, config=config)
    return found.having(replace(
        found.imaging.lens, centred=centred, bounds=bounds_of(centred, focal_reach),
        aspect_sigma=config.intrinsics.aspect_sigma))


def _narrowed(found: Estimate, losses: Sequence[tuple[float, int]] = LOSSES
              ) -> Estimate | None:
    """Return the optimum of all blocks, with a loss that narrows; None where no turn is left."""
    now = found
    for least_px, steps in losses:
        now = now.retriangulated(2 * least_px)
        if not now.scenes:
            return None
        now = optimised(now, least_px, steps, NEAR)
        # what was found first may be farther off than the bounds about it allow
        now = now.about(now.centred.with_focal(now.camera.fx))
    return now


def _chosen(begun: Sequence[_Begun], config: Config
            ) -> tuple[_Begun, tuple[Candidate, ...]]:
    """Return the kind of lens that explains the turns best, and how the kinds compare.

    A kind may lose by the bad poses of one turn only. So the others are found again from the poses
    of the best one; so is one that no turn began with, where the best one leaves much to explain,
    and a pinhole where that sees the same. A model that was requested stays.
    """
    best = next(each for each in begun
                if each.found is chosen_kind([other.found for other in begun])[0])
    if len(best.found.scenes) < 2:
        return best, ()
    rivals = []
    for model in searched(AUTO):
        if model.family == best.found.camera.family:
            continue
        own = [each for each in begun if each.found.camera.family == model.family]
        if (own or config.model != AUTO or field_size(best.found) > LARGE_FIELD
                or (model.family == PINHOLE and sees_as_pinhole(best.found.camera))):
            rivals += own
            with suppress(np.linalg.LinAlgError):
                camera = closest(best.found.imaging, model, best.found.scenes)
                again = _narrowed(_start(camera, best.found.scenes, camera, config))
                rivals += [] if again is None else [_Begun(again, best.profile)]
    found, tried = chosen_kind([best.found, *(each.found for each in rivals)])
    if config.model != AUTO:
        return best, tried
    winner = next(each for each in [best, *rivals] if each.found is found)
    profile = next((each.profile for each in begun
                    if each.found.camera.family == found.camera.family), winner.profile)
    return replace(winner, profile=profile), tried


def _with_all_tracks(found: Estimate, per_turn: Mapping[TurnId, Scene], config: Config
                     ) -> Estimate:
    # a shutter's displacements depend on the points: find these with a generous limit first
    generous = replace(
        found.having(Readout()),
        stretches=tuple(with_poses_of(per_turn[scene.turn], scene) for scene in found.scenes)
    ).retriangulated(CHAIN_ERROR * found.camera.image_size[0])
    seen = replace(generous, imaging=found.imaging).retriangulated().seen_by_lens
    kept = explained_by(seen, {scene.turn: scene for scene in seen}, found.camera, config)
    kept = with_better_poses(kept, list(per_turn.values()), found.camera, config.scene)
    return replace(found, stretches=tuple(
        replace(scene, tracks=per_turn[scene.turn].tracks) for scene in kept))


def _steadied(found: Estimate, per_turn: Mapping[TurnId, Scene], config: Config) -> Estimate:
    """Return the optimum where each image's picture may be shifted, as a stabiliser does.

    With a part of the tracks first, and without a readout: it looks alike, and may be far off.
    """
    start = found.having(Readout(), Shift())
    start = replace(start, imaging=start.imaging.anchored()).with_tracks(FIRST_TRACKS)
    near = _narrowed(start, ((LOSSES[0][0], config.intrinsics.crop_rounds), *LOSSES[1:]))
    if near is None:
        return found
    now = _with_all_tracks(near, per_turn, config)
    now = _finished(now) if now.scenes else now
    return now if len(now.scenes) == len(found.scenes) else found


def _with(found: Estimate, block: Block) -> Estimate:
    """Return the optimum with one more block.

    What it may do to the lens cannot be excluded, and sigma contains it.
    """
    return _finished(found.having(block))


def _finished(found: Estimate) -> Estimate:
    for steps in LAST_STEPS:
        found = optimised(found.retriangulated(), 0.0, steps)
    return found


def _perhaps_shifted(found: Estimate) -> frozenset[TurnId]:
    """Return the stretches whose pictures a stabiliser may have shifted; none where it is known.

    A shift and a small rotation differ by terms of the second order only, and those are the focal
    length. A sharp turn shows whether there is a stabiliser.
    """
    small = frozenset(scene.turn for scene in found.scenes if scene.yaw_deg < HIDDEN_DEG)
    if not small or found.config.known.stabiliser == 'no':
        return frozenset()
    sharp = tuple(scene for scene in found.scenes if scene.yaw_deg >= SHARP_DEG)
    if sharp:
        tests = fixed_camera_tests(replace(found, stretches=sharp))
        if not any(test.clear or (test.kind == 'shift' and test.strength > test.limit)
                   for test in tests):
            return frozenset()
    return small


def _posterior(found: Estimate) -> Posterior:
    lens = found.camera
    known = Posterior(
        lens, found.imaging.smooth.sigma**2 * lens_like(lens),
        tuple(costs_of(found, found.loss_px())),
        np.array([not scene.turn.of_this_drive for scene in found.scenes]), found.imaging.prior(),
        rivals=other_shape_of_pixels(found))
    sharpest = max(scene.yaw_deg for scene in found.scenes)
    if sharpest >= HIDDEN_DEG:
        return known
    return known.erring_together(
        GENTLE_SHIFTED * np.sqrt(HIDDEN_DEG / max(sharpest, LEAST_BEND_DEG)) if found.moves
        else GENTLE)


def _solution(found: Estimate, unlike: Mapping[TurnId, float], coarse: Profile,
              tried: tuple[Candidate, ...], tests: tuple[FixedCameraTest, ...],
              wanders: float, progress: Progress) -> Solution:
    """Return the solution with all that is known about it.

    unlike: each turn's misfit. coarse: the turns' focal profiles. wanders: RMS change of fx during
    the drive that is not excluded, of 1.
    """
    progress('estimating the uncertainty', 0.0)
    config, lens = found.config, found.camera
    posterior = _posterior(found).erring_together(wanders)
    result = written(found.imaging, posterior.covariance, found.scenes, config.model)
    scenes = tuple(result.seen(scene, found.imaging) for scene in found.scenes)
    progress('trying other focal lengths', 0.0)
    # beside a turn, straight stretches say little, and behind a windscreen something else
    # (7001 of benchmark/thorough.py)
    bends = [scene for scene in scenes if scene.yaw_deg >= BEND_DEG]
    turn = any(scene.yaw_deg >= HIDDEN_DEG for scene in scenes)
    around = profile_around(bends if turn else scenes, result.camera, coarse, config)
    count = len(result.camera.params)
    place, centred = found.imaging.places[Readout.name], found.centred
    shift = found.imaging.blocks.get(Shift.name, Shift())
    drift = found.imaging.blocks.get(Drift.name)
    assert isinstance(shift, Shift)
    return Solution(
        written=result, posterior=posterior, scenes=scenes, coarse=coarse, around=around,
        drift=FocalDrift.of(drift, posterior.covariance) if isinstance(drift, Drift) else None,
        centred=type(result.camera).centred(
            lens.image_size, centred.fx, *centred.params[4:min(count, 6)]),
        bounds=bounds_of(centred)[:, :count],
        readout_s=found.imaging.readout_s,
        readout_sigma_s=float(np.sqrt(posterior.covariance[place, place].item())),
        misfits=unlike, tried=tried,
        fixed_camera=tests, field_sigma=found.imaging.smooth.sigma,
        crops={} if shift.only else dict(shift.value),
        perhaps_shifted=shift.only or frozenset(),
        fixed=config.known.stabiliser == 'no' and not found.moves,
        unsettled=_unsettled(result, posterior.covariance, found.last))


def _unsettled(result: Written, covariance: Floats, last: Floats) -> float:
    """Return how far a step (m,) moves the rays over the picture, in units of their sigma."""
    if not len(last):
        return 0.0
    moved = np.sqrt(np.mean(np.sum((result.moves @ last)**2, axis=1)))
    return float(moved / result.sigma_map(covariance, with_field=True).whole.rms)
