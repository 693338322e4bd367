"""Scenes -> one camera, in the paper's two steps (3.2), and the information of each turn."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import AUTO
from dashcalib_ros.camera.mapping import sensitivity
from dashcalib_ros.config import Config
from dashcalib_ros.reconstruct.scene import Profile, Scene
from dashcalib_ros.solve.choice import Candidate
from dashcalib_ros.solve.departures import Departure
from dashcalib_ros.solve.field import without_field
from dashcalib_ros.solve.field_rounds import with_field, with_field_of_all_tracks
from dashcalib_ros.solve.fitting import adapted_to
from dashcalib_ros.solve.focal import kinds_of_lenses, nearest_start, profile_around, summed
from dashcalib_ros.solve.information import step_to_wider_model
from dashcalib_ros.solve.misfit import misfits
from dashcalib_ros.solve.model_choice import (
    chosen_of,
    compared_with_others,
    refitted,
    with_model_chosen,
)
from dashcalib_ros.solve.picture import picture_covariance
from dashcalib_ros.solve.prior import bounds_of, extra_sigma_of
from dashcalib_ros.solve.shutter import readout_sigma
from dashcalib_ros.solve.solution import Solution
from dashcalib_ros.solve.stabiliser import without_crops, without_stabiliser
from dashcalib_ros.solve.steps import (
    ByTurn,
    Progress,
    Result,
    step1,
    step2,
    step2_roughly,
    with_all_tracks,
)

# of a stabilised video's crop, with all tracks
FINAL_ROUNDS = 4


@dataclass(frozen=True)
class _Begun:
    """A kind of lens after the first steps. full_scenes: the turns with all their tracks."""

    result: Result
    full_scenes: ByTurn
    profile: Profile


def solve(separate: Sequence[Scene], config: Config,
          progress: Progress = lambda stage, done: None) -> Solution | None:
    """Adjust all scenes with one shared camera; None if the shared camera explains none of them.

    separate: at least one scene, each as its turn was reconstructed. The minimum of the summed
    focal profile is the start; a scene with a camera far from it is chained anew, and one that the
    shared camera does not explain is dropped. Where turns may be of two kinds of lenses, both are
    tried with a part of the tracks. Where the better one leaves something, larger models are
    tried, too.
    """
    begun = [found for kind in kinds_of_lenses(separate)
             if (found := _begun(kind, separate, config, progress)) is not None]
    if not begun:
        return None
    start, tried = _best_of(begun, config)
    progress('looking for a field', 0.0)
    roughly, full_scenes = with_field(start.result, config), start.full_scenes
    field = roughly.used_field
    if field is not None:
        full_scenes = {turn: without_field(scene, field) for turn, scene in full_scenes.items()}
    roughly = _steadied(roughly, config)
    crops = roughly.fit.crops
    if crops:
        full_scenes = {turn: without_crops(full_scenes[turn], crops) for turn in crops}
    complete = with_all_tracks(roughly.fit, full_scenes, separate, config)
    if not complete.scenes:
        return None
    complete = with_field_of_all_tracks(replace(roughly, fit=complete), config).fit
    final = step2(complete, full_scenes, roughly.step1, config, progress)
    result = Result(final, roughly.step1, config.intrinsics)
    if crops:
        # a part of the tracks leaves the crops uncertain
        result = without_stabiliser(result, config, FINAL_ROUNDS)
    elif config.model == AUTO and field is None:
        progress('choosing the lens model', 0.0)
        result, others = with_model_chosen(result, full_scenes, config)
        tried = _merged(tried, others)
    elif config.model != AUTO:
        progress('comparing the lens model with others', 0.0)
        tried = compared_with_others(result, full_scenes, config)
    progress('trying other focal lengths', 0.0)
    around = profile_around(result.fit.scenes, result.fit.camera, start.profile, config)
    progress('estimating the uncertainty', 0.0)
    return _solution(result, separate, (start.profile, around), tried, config)


def _steadied(first: Result, config: Config) -> Result:
    """Return the result with a stabilised video's crop held, if that is what the video shows."""
    def moves(found: Sequence[Departure]) -> bool:
        return found[0].kind == 'shift' and found[0].clear

    rounds = config.intrinsics.crop_rounds
    # the bend takes longer, and is asked for only where the picture moves
    if not rounds or not moves(first.departures(bent=False)) or not moves(first.departures()):
        return first
    return without_stabiliser(first, config, rounds)


def _best_of(begun: Sequence[_Begun], config: Config) -> tuple[_Begun, tuple[Candidate, ...]]:
    """Return the kind of lens that explains the turns best, and how the kinds compare.

    A kind may lose by the bad poses of one turn only. So all are tried again from those of the
    best one, that one too: it must not win or lose by fewer steps of adjustment. Where that one
    then explains a turn no more, there is nothing to compare the others with, and it stays.
    """
    def chosen(found: Sequence[_Begun]) -> tuple[_Begun, tuple[Candidate, ...]]:
        result, tried = chosen_of([each.result for each in found], config)
        return next(each for each in found if each.result is result), tried

    best, tried = chosen(begun)
    if len(begun) == 1 or len(best.result.parts) < 2:
        return best, tried
    again = [replace(each, result=result) for each in begun if (result := refitted(
        best.result, type(each.result.fit.camera), best.full_scenes, config)) is not None]
    best_again = any(type(each.result.fit.camera) is type(best.result.fit.camera)
                     for each in again)
    return chosen(again) if best_again else (best, tried)


def _begun(kind: str, separate: Sequence[Scene], config: Config, progress: Progress
           ) -> _Begun | None:
    """Return the first steps for one kind of lens, with a part of the tracks.

    None where the shared camera explains none of the scenes.
    """
    starts = [scene.starts[kind] for scene in separate if kind in scene.starts]
    profile = summed([start.profile for start in starts])
    start = nearest_start([start.camera for start in starts], profile)
    full_scenes = {scene.turn: adapted_to(scene, start, config) for scene in separate}
    first = step1(full_scenes, start, config, progress)
    if not first.scenes:
        return None
    progress('adjusting all parameters', 0.0)
    rough = step2_roughly(first, config)
    return _Begun(Result(rough, first.camera, config.intrinsics), full_scenes, profile)


def _merged(first: Sequence[Candidate], later: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """Return all candidates, the later figure of those that are in both."""
    found = {each.model: each for each in (*first, *later)}
    return tuple(found.values()) if len(found) > 1 else ()


def _shared_with_field(result: Result) -> Floats:
    """Return (n,) how far each parameter would go if it took up a field of this size.

    Where the lens ends and the field begins is agreed on, not measured: another calibration may
    have the same rays and another share of both. Over the picture it makes no difference.
    """
    camera, field = result.fit.camera, result.used_field
    if field is None:
        return np.zeros(len(camera.names()))
    moves, _ = sensitivity(camera)
    by_unit = np.sqrt(np.mean(np.sum(moves**2, axis=1), axis=0))
    return np.asarray(np.sqrt(np.mean(field.over(camera)**2)) / by_unit)


def _solution(result: Result, separate: Sequence[Scene], profiles: tuple[Profile, Profile],
              tried: tuple[Candidate, ...], config: Config) -> Solution:
    """Return the solution with its covariance. profiles: the coarse one, and that around it."""
    settings = config.intrinsics
    final, step1, parts = result.fit, result.step1, result.parts
    scenes, camera, readout_s = final.scenes, final.camera, final.readout_s
    prior = result.prior
    count = len(prior)
    departed = result.departures()
    systematic = max(1.0, *(each.strength for each in departed))
    step = step_to_wider_model(parts, prior, extra_sigma_of(camera))
    spread = picture_covariance(camera, parts, prior, result.floor, step, systematic,
                                result.one_turn_sigma)
    return Solution(
        camera=camera, covariance=spread[:count, :count] + np.diag(_shared_with_field(result)**2),
        step1=step1,
        scenes=tuple(scenes), parts=parts, coarse=profiles[0], around=profiles[1],
        bounds=np.array(bounds_of(step1, settings)), prior_information=prior, readout_s=readout_s,
        readout_sigma_s=readout_sigma(parts, prior, systematic) if readout_s else 0.0,
        misfits=misfits(separate, scenes, camera, config.scene.error_px), tried=tried,
        sigma_map=result.sigma_map(systematic), systematic=systematic, departures=departed,
        crops=final.crops, field=final.field, floor=result.floor,
        one_turn_sigma=result.one_turn_sigma)
