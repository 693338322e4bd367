"""Larger models of the lens are tried where errors are left to explain, and one is chosen.

The one that predicts turns it was not fitted to: each turn is left out in turn. At a model's
solution the cost of every turn is known as a quadratic function of the camera's parameters, so
that the camera without a turn, and what it costs that turn, need no new adjustment. A model with
too many parameters fits the other turns better and the one left out worse: nothing has to be known
of the number of parameters.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import MODELS, Camera, calibrated_models, larger_models
from dashcalib_ros.camera.mapping import as_model, mapping_error
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.reconstruct.scene import Scene, errors_px
from dashcalib_ros.solve.knowledge import is_clear
from dashcalib_ros.solve.solution import Candidate
from dashcalib_ros.solve.steps import Fit, fit_all, is_rolling

# a lens with p1, p2 of 0.003 looks like a shutter of 3 ms
SHORT_READOUT_S = 0.008
# of tracks, at least, where another model is made to map alike
PLACES = 500


def with_model_chosen(first: Fit) -> tuple[Fit, tuple[Candidate, ...]]:
    """Return the result with the model that the turns prove, and how the models compare.

    Others are tried only where the first one leaves something for them to explain, and with a part
    of the tracks; the one that is chosen is adjusted with all.
    """
    if len(first.scenes) < 2 or not leaves_more(first):
        return first, ()
    chosen, tried = chosen_of(_with_models(first, larger_models(first.camera)))
    model = type(chosen.camera)
    if model is type(first.camera):
        return first, tried
    return refitted_without_shutter(first, model) or first, tried


def compared_with_others(asked: Fit) -> tuple[Candidate, ...]:
    """Return how a model that was asked for compares with all others, with a part of the tracks.

    Empty where one turn is all there is, or no other model explains the turns.
    """
    if len(asked.scenes) < 2:
        return ()
    camera = asked.camera
    results = _with_models(asked, [model for model in calibrated_models()
                                   if model is not type(camera)])
    if not any(type(result.camera) is type(camera) for result in results):
        return ()
    chosen, tried = chosen_of(results)
    # the result is adjusted with all tracks
    apart_px = mapping_error(camera, chosen.camera)
    return tuple(replace(each, apart_px=apart_px) if each.model == camera.model else each
                 for each in tried)


def _with_models(fit: Fit, others: Sequence[type[Camera]]) -> list[Fit]:
    """Return the fit with a part of its tracks, in its own model and in others that fit."""
    few, larger = fit.with_few_tracks(), larger_models(fit.camera)
    found = [(refitted_without_shutter if model in larger else refitted)(few, model)
             for model in (type(fit.camera), *others)]
    return [result for result in found if result is not None]


def left_out_costs(fit: Fit, loss_px: float) -> dict[TurnId, float]:
    """Return for each turn its cost with the camera of the other turns, px^2.

    loss_px: of the Cauchy loss. With one turn only, its cost with its own camera.
    """
    known, limit_px, costs = fit.known, fit.config.scene.error_px, {}
    total = np.linalg.inv(known.total.covariance)
    for scene, turn in zip(fit.scenes, known.turns_at_optimum, strict=True):
        errors = np.minimum(errors_px(scene, fit.camera), limit_px)[scene.tracks.seen]
        costs[scene.turn] = float(loss_px**2 * np.log1p(errors**2 / loss_px**2).sum())
        if len(fit.scenes) > 1:
            step = np.asarray(-np.linalg.solve(total - turn.hessian, turn.score))
            costs[scene.turn] += known.noise * turn.change(step)
    return costs


def chosen_of(results: Sequence[Fit]) -> tuple[Fit, tuple[Candidate, ...]]:
    """Return the result whose model predicts the turns best, and how the others compare.

    The simplest comes first; one with more parameters must be clearly better, and map rays
    differently by more than its sigma. A fisheye comes after all pinholes, and must be clearly
    better than each of them: a decentred pinhole is none.
    """
    if len(results) == 1:
        return results[0], ()
    families = list(dict.fromkeys(model.family for model in MODELS.values()))
    results = sorted(results, key=lambda result: (families.index(result.camera.family),
                                                  len(result.camera.names())))
    loss_px = min(result.solver.loss_px for result in results)
    costs = [left_out_costs(result, loss_px) for result in results]
    noise = min(result.known.noise for result in results)
    inflation = min(result.known.track_inflation for result in results)
    # a turn that a camera does not explain at all counts against it
    worst = {turn: max(cost.get(turn, 0.0) for cost in costs) for cost in costs for turn in cost}
    gains = [{turn: (worst[turn] - cost.get(turn, 2 * worst[turn])) / noise / inflation
              for turn in worst} for cost in costs]
    best = 0
    for n in range(1, len(results)):
        rivals = [best, *(m for m in range(n)
                          if results[m].camera.family != results[n].camera.family)]
        clear = all(is_clear(np.array([gains[n][turn] - gains[m][turn] for turn in worst]))
                    for m in rivals)
        if clear and not _alike(results[n], results[best]):
            best = n
    chosen = results[best]
    totals = [sum(cost.get(turn, 2 * worst[turn]) for turn in worst) for cost in costs]
    return chosen, tuple(Candidate(
        result.camera.model, sum(gains[best].values()) - sum(gains[n].values()),
        mapping_error(result.camera, chosen.camera), result is chosen,
        totals[n] / totals[best])
        for n, result in sorted(enumerate(results),
                                key=lambda each: len(each[1].camera.names())))


def refitted_without_shutter(first: Fit, model: type[Camera]) -> Fit | None:
    """Return the result with another model and a global shutter; None where that is not enough.

    A decentred lens looks like a short rolling shutter, and what the removal of a true one leaves
    over looks like a decentred lens: the larger model must do without.
    """
    if not first.readout_s:
        return refitted(first, model)
    found = refitted(first.as_measured(), model)
    return None if found is None or is_rolling(*found.readout_left) else found


def leaves_more(result: Fit) -> bool:
    """Return whether errors are left with which a wider model predicts the turns better."""
    camera = result.camera
    if type(camera.widened()) is type(camera):
        return False
    if result.readout_s:
        return abs(result.readout_s) < SHORT_READOUT_S
    return is_clear(result.known.gains_of_wider_model / result.known.track_inflation)


def refitted(first: Fit, model: type[Camera]) -> Fit | None:
    """Return the turns explained with a model, from the poses that they have now.

    None where it does not explain all of them.
    """
    camera = first.camera
    if type(camera) is not model:
        # where nothing was seen the first one may be far off, and must not draw the other there
        camera = as_model(camera, model, _seen(first.scenes))
    centred = camera
    if model.family == first.centred.family:
        distortion = first.centred.params[4:len(model.names())]
        centred = model.centred(camera.image_size, first.centred.fx, *distortion)
    ready = replace(first, camera=camera, centred=centred).retriangulated()
    if len(ready.scenes) < len(first.scenes):
        return None
    fit = fit_all(ready)
    return None if len(fit.scenes) < len(first.scenes) else fit


def _seen(scenes: Sequence[Scene]) -> Floats:
    """Return (n, 2) where in the picture tracks are seen, some of them."""
    places = np.concatenate([scene.tracks.xy[scene.structure.used] for scene in scenes])
    return np.asarray(places[::max(1, len(places) // PLACES)])


def _alike(larger: Fit, simpler: Fit) -> bool:
    """Return whether two models map rays alike, as far as the turns can tell."""
    apart = mapping_error(larger.camera, simpler.camera)
    return apart is not None and apart < larger.known.sigma_map(larger.used_field).whole.rms
