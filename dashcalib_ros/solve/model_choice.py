"""Larger models of the lens are tried where the simplest leaves something, and one is chosen."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera, calibrated_models, larger_models
from dashcalib_ros.camera.mapping import as_model, mapping_error
from dashcalib_ros.config import Config
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.solve.choice import (
    Candidate,
    gain_of_wider_model,
    held_out_costs,
    is_clear,
    track_inflation,
)
from dashcalib_ros.solve.fitting import retriangulate_all, subsample_tracks
from dashcalib_ros.solve.information import noise_of, pooled
from dashcalib_ros.solve.prior import extra_sigma_of
from dashcalib_ros.solve.shutter import readout
from dashcalib_ros.solve.steps import ByTurn, Result, is_rolling, step2

# a lens with p1, p2 of 0.003 looks like a shutter of 3 ms
SHORT_READOUT_S = 0.008
# of tracks, at least, where another model is made to map alike
PLACES = 500


def with_model_chosen(first: Result, full_scenes: ByTurn, config: Config
                      ) -> tuple[Result, tuple[Candidate, ...]]:
    """Return the result with the model that the turns prove, and how the models compare.

    Others are tried only where the first one leaves something for them to explain, and with a part
    of the tracks; the one that is chosen is adjusted with all.
    """
    camera = first.fit.camera
    if len(first.parts) < 2 or not _leaves_more(first, config):
        return first, ()
    models = larger_models(camera)
    few, measured = _few(first, full_scenes, config)
    found = [_refitted(few, type(camera), measured, config),
             *(_without_shutter(few, model, measured, config) for model in models)]
    chosen, tried = chosen_of([result for result in found if result is not None], config)
    model = type(chosen.fit.camera)
    if model is type(camera):
        return first, tried
    return _without_shutter(first, model, full_scenes, config) or first, tried


def refitted(result: Result, model: type[Camera], full_scenes: ByTurn, config: Config
             ) -> Result | None:
    """Return a result's turns explained with a model, from the poses that they have now.

    None where it does not explain all of them.
    """
    few, measured = _few(result, full_scenes, config)
    return _refitted(few, model, measured, config)


def compared_with_others(asked: Result, full_scenes: ByTurn, config: Config
                         ) -> tuple[Candidate, ...]:
    """Return how a model that was asked for compares with all others, with a part of the tracks.

    Empty where one turn is all there is, or no other model explains the turns.
    """
    if len(asked.parts) < 2:
        return ()
    few, measured = _few(asked, full_scenes, config)
    camera = asked.fit.camera
    larger = larger_models(camera)
    found = [_refitted(few, type(camera), measured, config)]
    if found[0] is None:
        return ()
    for model in calibrated_models():
        if model is not type(camera):
            fitted = _without_shutter if model in larger else _refitted
            found.append(fitted(few, model, measured, config))
    chosen, tried = chosen_of([result for result in found if result is not None], config)
    # the result is adjusted with all tracks
    apart_px = mapping_error(camera, chosen.fit.camera)
    return tuple(replace(each, apart_px=apart_px) if each.model == camera.model else each
                 for each in tried)


def chosen_of(results: Sequence[Result], config: Config) -> tuple[Result, tuple[Candidate, ...]]:
    """Return the result whose model foretells the turns best, and how the others compare.

    The simplest comes first; one with more parameters must be clearly better, and map rays
    differently by more than its sigma.
    """
    if len(results) == 1:
        return results[0], ()
    results = sorted(results, key=lambda result: len(result.fit.camera.names()))
    loss_px = min(result.fit.solver.loss_px for result in results)
    priors = [result.prior for result in results]
    costs = [held_out_costs(result.fit.scenes, result.fit.camera, result.parts, prior, loss_px,
                            config.scene.error_px)
             for result, prior in zip(results, priors, strict=True)]
    noise = min(noise_of(result.parts) for result in results)
    inflation = min(track_inflation(pooled(result.parts, prior))
                    for result, prior in zip(results, priors, strict=True))
    # a turn that a camera does not explain at all counts against it
    worst = {turn: max(cost.get(turn, 0.0) for cost in costs) for cost in costs for turn in cost}
    gains = [{turn: (worst[turn] - cost.get(turn, 2 * worst[turn])) / noise / inflation
              for turn in worst} for cost in costs]
    best = 0
    for n in range(1, len(results)):
        clear = is_clear(np.array([gains[n][turn] - gains[best][turn] for turn in worst]),
                         config.intrinsics.least_gain)
        if clear and not _alike(results[n], results[best], config):
            best = n
    chosen = results[best]
    totals = [sum(cost.get(turn, 2 * worst[turn]) for turn in worst) for cost in costs]
    return chosen, tuple(Candidate(
        result.fit.camera.model, sum(gains[best].values()) - sum(gains[n].values()),
        mapping_error(result.fit.camera, chosen.fit.camera), result is chosen,
        totals[n] / totals[best])
        for n, result in enumerate(results))


def _few(first: Result, full_scenes: ByTurn, config: Config) -> tuple[Result, ByTurn]:
    """Return the result, and the scenes as they were measured, with a part of the tracks."""
    wanted = config.intrinsics.first_tracks
    scenes = [subsample_tracks(scene, wanted) for scene in first.fit.scenes]
    return (replace(first, fit=replace(first.fit, scenes=scenes)),
            {turn: subsample_tracks(scene, wanted) for turn, scene in full_scenes.items()})


def _without_shutter(first: Result, model: type[Camera], measured: ByTurn, config: Config
                     ) -> Result | None:
    """Return the result with another model and a global shutter; None where that is not enough.

    A decentred lens looks like a short rolling shutter, and what the removal of a true one leaves
    over looks like a decentred lens: the larger model must do without.
    """
    if not first.fit.readout_s:
        return _refitted(first, model, measured, config)
    scenes = [replace(scene, tracks=measured[scene.turn].tracks) for scene in first.fit.scenes]
    found = _refitted(replace(first, fit=replace(first.fit, scenes=scenes, readout_s=0.0)),
                      model, measured, config)
    if found is None:
        return None
    left_s, sigma_s = readout(
        found.fit.scenes, found.fit.camera, found.fit.solver.loss_px, found.prior)
    return None if is_rolling(left_s, sigma_s, config.intrinsics) else found


def _leaves_more(result: Result, config: Config) -> bool:
    """Return whether a wider model may foretell the turns clearly better."""
    camera = result.fit.camera
    if type(camera.widened()) is type(camera):
        return False
    if result.fit.readout_s:
        return abs(result.fit.readout_s) < SHORT_READOUT_S
    prior = result.prior
    gains = gain_of_wider_model(result.parts, prior, extra_sigma_of(camera))
    return is_clear(gains / track_inflation(pooled(result.parts, prior)),
                    config.intrinsics.least_gain)


def _refitted(first: Result, model: type[Camera], full_scenes: ByTurn, config: Config
              ) -> Result | None:
    """Return the result with another model, None where it does not explain all turns."""
    camera = first.fit.camera
    if type(camera) is not model:
        # where nothing was seen the first one may be far off, and must not draw the other there
        camera = as_model(camera, model, _seen(first.fit.scenes))
    step1 = camera
    if model.family == first.step1.family:
        distortion = first.step1.params[4:len(model.names())]
        step1 = model.centred(camera.image_size, first.step1.fx, *distortion)
    scenes = retriangulate_all(first.fit.scenes, camera, config.scene)
    if len(scenes) < len(first.fit.scenes):
        return None
    fit = step2(replace(first.fit, scenes=scenes, camera=camera), full_scenes, step1, config)
    if len(fit.scenes) < len(first.fit.scenes):
        return None
    return Result(fit, step1, config.intrinsics)


def _seen(scenes: Sequence[Scene]) -> Floats:
    """Return (n, 2) where in the picture tracks are seen, some of them."""
    places = np.concatenate([scene.tracks.xy[scene.structure.used] for scene in scenes])
    return np.asarray(places[::max(1, len(places) // PLACES)])


def _alike(larger: Result, simpler: Result, config: Config) -> bool:
    """Return whether two models map rays alike, as far as the turns can tell."""
    apart = mapping_error(larger.fit.camera, simpler.fit.camera)
    return apart is not None and apart < larger.sigma_map().whole.rms
