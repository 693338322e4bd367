"""Scenes -> one camera, in the paper's two steps (3.2), and what each turn knows of it."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import AUTO, MODELS
from dashcalib_ros.camera.mapping import sensitivity
from dashcalib_ros.config import Config
from dashcalib_ros.reconstruct.scene import Profile, Scene
from dashcalib_ros.solve.field import without_field
from dashcalib_ros.solve.field_rounds import with_field, with_field_of_all_tracks
from dashcalib_ros.solve.fitting import adapted_to, misfits
from dashcalib_ros.solve.fixed_camera import FixedCameraTest
from dashcalib_ros.solve.focal import kinds_of_lenses, nearest_start, profile_around, summed
from dashcalib_ros.solve.model_choice import (
    chosen_of,
    compared_with_others,
    leaves_more,
    refitted,
    refitted_without_shutter,
    with_model_chosen,
)
from dashcalib_ros.solve.prior import bounds_of, centre_pull
from dashcalib_ros.solve.solution import CLEAR_KIND_RATIO, Candidate, Solution
from dashcalib_ros.solve.stabiliser import without_crops, without_stabiliser
from dashcalib_ros.solve.steps import (
    Fit,
    Progress,
    fit_all,
    fit_one_focal_length,
    fit_roughly,
    with_all_tracks,
)

# of a stabilised video's crop, with all tracks
FINAL_ROUNDS = 4


@dataclass(frozen=True)
class _Begun:
    """A kind of lens after the first fit, and the sum of its turns' focal profiles."""

    fit: Fit
    profile: Profile


def solve(per_turn: Sequence[Scene], config: Config,
          progress: Progress = lambda stage, done: None) -> Solution | None:
    """Adjust all scenes with one shared camera; None if it explains none, or none determines it.

    per_turn: at least one scene, each as its turn was reconstructed. The minimum of the summed
    focal profile is the start; a scene with a camera far from it is chained anew, and one that the
    shared camera does not explain is dropped. Where turns may be of a pinhole or of a fisheye,
    both are tried with a part of the tracks. Larger lens models are tried where they may explain
    what is left of the errors.
    """
    try:
        return _solved(per_turn, config, progress)
    except np.linalg.LinAlgError:
        # nothing limits a direction of the parameters: pictures that slide past show no depth
        return None


def _solved(per_turn: Sequence[Scene], config: Config, progress: Progress) -> Solution | None:
    begun = [found for kind in kinds_of_lenses(per_turn)
             if (found := _begun(kind, per_turn, config, progress)) is not None]
    if not begun:
        return None
    start, tried = _best_of(begun)
    progress('looking for a field', 0.0)
    fit = _steadied(_with_field(start.fit))
    fit = with_all_tracks(replace(fit, measured={
        scene.turn: _without_distortions(fit, scene) for scene in fit.measured.values()}),
        per_turn)
    if not fit.scenes:
        return None
    fit = fit_all(with_field_of_all_tracks(fit), progress)
    if fit.crops:
        # a part of the tracks leaves the crops uncertain
        fit = without_stabiliser(fit, FINAL_ROUNDS)
    elif config.model == AUTO and fit.used_field is None:
        progress('choosing the lens model', 0.0)
        fit, others = with_model_chosen(fit)
        tried = _merged(tried, others)
    elif config.model == AUTO:
        # models of the same kind were compared with the field in the tracks
        tried = tuple(each for each in tried if MODELS[each.model].family != fit.camera.family)
    else:
        progress('comparing the lens model with others', 0.0)
        tried = compared_with_others(fit)
    progress('trying other focal lengths', 0.0)
    around = profile_around(fit.scenes, fit.camera, start.profile, config)
    progress('estimating the uncertainty', 0.0)
    return _solution(fit, per_turn, (start.profile, around), tried)


def _with_field(first: Fit) -> Fit:
    """Return the fit with the field that the turns confirm, and that no wider model explains.

    A decentred lens bends the picture, too, and also where no track goes.
    """
    found = with_field(first)
    if found.used_field is None or first.config.model != AUTO or not leaves_more(first):
        return found
    few, wider = first.with_few_tracks(), type(first.camera.widened())
    plain, decentred = refitted(few, type(first.camera)), refitted_without_shutter(few, wider)
    if plain is None or decentred is None or chosen_of([plain, decentred])[0] is plain:
        return found
    return first if with_field(decentred).used_field is None else found


def _without_distortions(fit: Fit, scene: Scene) -> Scene:
    """Return a turn with all its tracks, the field and the crop that were found taken out."""
    if fit.used_field is not None:
        scene = without_field(scene, fit.used_field)
    return without_crops(scene, fit.crops) if scene.turn in fit.crops else scene


def _steadied(first: Fit) -> Fit:
    """Return the fit with a fixed crop of a stabilised video, if that is what the video shows."""
    def moves(found: Sequence[FixedCameraTest]) -> bool:
        return found[0].kind == 'shift' and found[0].clear

    rounds = first.config.intrinsics.crop_rounds
    # the bend takes longer, and is asked for only where the picture moves
    if (not rounds or not moves(first.fixed_camera_tests(bent=False))
            or not moves(first.fixed_camera_tests())):
        return first
    return without_stabiliser(first, rounds)


def _best_of(begun: Sequence[_Begun]) -> tuple[_Begun, tuple[Candidate, ...]]:
    """Return the kind of lens that explains the turns best, and how the kinds compare.

    A kind may lose by the bad poses of one turn only. So all are fitted again from the poses of
    the best one. That one is fitted again, too: it must not win or lose by fewer steps of
    adjustment. Where it then explains a turn no more, there is nothing to compare the others with,
    and it stays. Each kind is tried with all its coefficients, too: a decentred pinhole is no
    fisheye. Kinds that explain the turns about as well are compared with the fields that they
    leave: a fisheye's four coefficients take up a part of what a windscreen bends. Which of its
    models is used is chosen later.
    """
    def chosen(found: Sequence[_Begun]) -> tuple[_Begun, tuple[Candidate, ...]]:
        fit, tried = chosen_of([each.fit for each in found])
        return next(each for each in found if each.fit is fit), tried

    best, tried = chosen(begun)
    if len(begun) == 1 or len(best.fit.scenes) < 2:
        return best, tried
    few = best.fit.with_few_tracks()
    again = [replace(each, fit=replace(fit, measured=each.fit.measured)) for each in begun
             for model in dict.fromkeys([type(each.fit.camera), type(each.fit.camera.widened())])
             if (fit := refitted(few, model)) is not None]
    if not any(type(each.fit.camera) is type(best.fit.camera) for each in again):
        return best, tried
    found, tried = chosen(again)
    family = found.fit.camera.family
    if any(each.cost_ratio < CLEAR_KIND_RATIO for each in tried
           if MODELS[each.model].family != family):
        found, tried = chosen([replace(each, fit=with_field(each.fit)) for each in again])
    kinds = {type(each.fit.camera) for each in begun}
    return next(each for each in [*again, *begun] if type(each.fit.camera) in kinds
                and each.profile is found.profile), tried


def _begun(kind: str, per_turn: Sequence[Scene], config: Config, progress: Progress
           ) -> _Begun | None:
    """Return the first fit for one kind of lens, with a part of the tracks.

    None where the shared camera explains none of the scenes.
    """
    starts = [scene.starts[kind] for scene in per_turn if kind in scene.starts]
    profile = summed([start.profile for start in starts])
    start = nearest_start([start.camera for start in starts], profile)
    measured = {scene.turn: adapted_to(scene, start, config) for scene in per_turn}
    first = fit_one_focal_length(measured, start, config, progress)
    if not first.scenes:
        return None
    progress('adjusting all parameters', 0.0)
    return _Begun(fit_roughly(first), profile)


def _merged(first: Sequence[Candidate], later: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """Return all candidates, the later figure of those that are in both."""
    found = {each.model: each for each in (*first, *later)}
    return tuple(found.values()) if len(found) > 1 else ()


def _shared_with_field(fit: Fit) -> Floats:
    """Return (n,) how far each parameter would go if it took up a field of this size.

    Where the lens ends and the field begins is agreed on, not measured: another calibration may
    have the same rays and another share of both. Over the picture it makes no difference.
    """
    if fit.field is None:
        return np.zeros(len(fit.camera.names()))
    moves, _ = sensitivity(fit.camera)
    by_unit = np.sqrt(np.mean(np.sum(moves**2, axis=1), axis=0))
    return np.asarray(fit.field.rms_over(fit.camera) / by_unit)


def _solution(fit: Fit, per_turn: Sequence[Scene], profiles: tuple[Profile, Profile],
              tried: tuple[Candidate, ...]) -> Solution:
    """Return the solution with its covariance. profiles: the coarse one, and that around it."""
    tests = fit.fixed_camera_tests()
    known = replace(fit.known, systematic=max(1.0, *(each.strength for each in tests)))
    covariance = known.covariance[np.ix_(known.own, known.own)]
    pull = centre_pull(fit.camera, covariance)
    return Solution(
        camera=fit.camera, centred=fit.centred, scenes=tuple(fit.scenes), known=known,
        covariance=covariance + np.outer(pull, pull) + np.diag(_shared_with_field(fit)**2),
        coarse=profiles[0], around=profiles[1],
        bounds=np.array(bounds_of(fit.centred)), readout_s=fit.readout_s,
        readout_sigma_s=known.readout_sigma if fit.readout_s else 0.0,
        misfits=misfits(per_turn, fit.scenes, fit.camera, fit.config.scene.error_px),
        tried=tried,
        sigma_map=known.sigma_map(fit.used_field), fixed_camera=tests, crops=fit.crops,
        field=fit.field)
