"""Scenes -> one camera, in the paper's two steps (3.2), and the information of each turn."""
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import AUTO, Camera, larger_models
from dashcalib_ros.camera.mapping import as_model, mapping_error
from dashcalib_ros.config import Config, IntrinsicsConfig
from dashcalib_ros.reconstruction.adjust import Solver, adjust_step1, adjust_step2
from dashcalib_ros.reconstruction.scene import Profile, Scene
from dashcalib_ros.solve.choice import (
    Candidate,
    gain_of_wider_model,
    held_out_costs,
    is_clear,
    track_inflation,
)
from dashcalib_ros.solve.departures import Crops, Departure, departures, shift_prior
from dashcalib_ros.solve.fitting import (
    adapted_to,
    explained_by,
    retriangulate_all,
    subsample_tracks,
    with_better_poses,
    with_poses_of,
)
from dashcalib_ros.solve.focal import kinds_of_lenses, nearest_start, profile_around, summed
from dashcalib_ros.solve.information import (
    Information,
    covariance,
    information,
    noise_in,
    noise_of,
    pooled,
    step_to_wider_model,
)
from dashcalib_ros.solve.misfit import misfits
from dashcalib_ros.solve.picture import PictureSigma, picture_sigma
from dashcalib_ros.solve.prior import (
    bounds_of,
    extra_sigma_of,
    floor_of,
    loss_px_of,
    prior_information,
    prior_of,
)
from dashcalib_ros.solve.shutter import readout, remove_rolling_shutter, row_shift
from dashcalib_ros.solve.solution import Solution
from dashcalib_ros.solve.stabiliser import (
    Steadied,
    fixed_crops,
    without_crops,
    without_stabiliser,
)
from dashcalib_ros.turns.turn import TurnId

# a lens with p1, p2 of 0.003 looks like a shutter of 3 ms
SHORT_READOUT_S = 0.008
# of a stabilised video's crop, with all tracks
FINAL_ROUNDS = 4

ByTurn = Mapping[TurnId, Scene]
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class _Fit:
    """The state of the adjustment. readout_s: of the rolling shutter that was removed.

    crops: of the stabilised video, as removed; empty for a fixed picture.
    """

    scenes: list[Scene]
    camera: Camera
    solver: Solver
    readout_s: float = 0.0
    crops: Crops = field(default_factory=dict)


@dataclass(frozen=True)
class _Result:
    """A fit at its end, and what the priors come from."""

    fit: _Fit
    step1: Camera
    settings: IntrinsicsConfig

    @cached_property
    def parts(self) -> tuple[Information, ...]:
        """Return what each turn says of the lens."""
        fit = self.fit
        loss_px = fit.solver.loss_px
        noise = noise_in(fit.scenes, fit.camera, loss_px)
        return tuple(information(
            scene, fit.camera, loss_px, row_shift(scene, fit.camera) if fit.readout_s else None,
            shift_prior(scene, noise, self.settings, fit.crops[scene.turn]) if fit.crops else None)
            for scene in fit.scenes)

    def departures(self, bent: bool = True) -> tuple[Departure, ...]:
        """Return how the drive departs from a fixed camera, the strongest first."""
        scenes = [subsample_tracks(scene, self.settings.first_tracks) for scene in self.fit.scenes]
        return departures(scenes, self.fit.camera, self.step1, self.fit.solver.loss_px,
                          self.settings, self.fit.crops, bent, bool(self.fit.readout_s))


@dataclass(frozen=True)
class _Begun:
    """A kind of lens after the first steps. full_scenes: the turns with all their tracks."""

    result: _Result
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
    roughly, tried = _chosen([each.result for each in begun], config)
    start = next(each for each in begun if each.result is roughly)
    roughly = _steadied(roughly, config)
    crops, full_scenes = roughly.fit.crops, start.full_scenes
    if crops:
        full_scenes = {turn: without_crops(full_scenes[turn], crops) for turn in crops}
    complete = _with_all_tracks(roughly.fit, full_scenes, separate, config)
    if not complete.scenes:
        return None
    final = _step2(complete, full_scenes, roughly.step1, config, progress)
    result = _Result(final, roughly.step1, config.intrinsics)
    if crops:
        # a part of the tracks leaves the crops uncertain
        result = _without_stabiliser(result, config, FINAL_ROUNDS)
    elif config.model == AUTO:
        progress('model of the lens', 0.0)
        result, others = _with_model_chosen(result, full_scenes, config)
        tried = _merged(tried, others)
    progress('focal profile', 0.0)
    around = profile_around(result.fit.scenes, result.fit.camera, start.profile, config)
    progress('sigma', 0.0)
    return _solution(result, separate, (start.profile, around), tried, config)


def _steadied(first: _Result, config: Config) -> _Result:
    """Return the result with a stabilised video's crop held, if that is what the video shows."""
    def moves(found: Sequence[Departure]) -> bool:
        return found[0].kind == 'shift' and found[0].clear

    rounds = config.intrinsics.crop_rounds
    # the bend takes longer, and is asked for only where the picture moves
    if not rounds or not moves(first.departures(bent=False)) or not moves(first.departures()):
        return first
    return _without_stabiliser(first, config, rounds)


def _without_stabiliser(first: _Result, config: Config, rounds: int) -> _Result:
    """Return the result with the movement of the crop taken out; the same if a turn is lost."""
    fit = first.fit
    found = without_stabiliser(
        Steadied(fit.scenes, fit.camera, first.step1, fit.readout_s,
                 fit.crops or fixed_crops(fit.scenes)), config, rounds)
    if len(found.scenes) < len(fit.scenes):
        return first
    solver = replace(fit.solver, loss_px=loss_px_of(found.scenes, found.camera, config.intrinsics))
    return _Result(_Fit(found.scenes, found.camera, solver, found.readout_s, found.crops),
                   found.step1, config.intrinsics)


def _begun(kind: str, separate: Sequence[Scene], config: Config, progress: Progress
           ) -> _Begun | None:
    """Return the first steps for one kind of lens, with a part of the tracks.

    None where the shared camera explains none of the scenes.
    """
    starts = [scene.starts[kind] for scene in separate if kind in scene.starts]
    profile = summed([start.profile for start in starts])
    start = nearest_start([start.camera for start in starts], profile)
    full_scenes = {scene.turn: adapted_to(scene, start, config) for scene in separate}
    first = _step1(full_scenes, start, config, progress)
    if not first.scenes:
        return None
    progress('step 2: all parameters', 0.0)
    rough = _step2_roughly(first, config)
    return _Begun(_Result(rough, first.camera, config.intrinsics), full_scenes, profile)


def _merged(first: Sequence[Candidate], later: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """Return all candidates, the later figure of those that are in both."""
    found = {each.model: each for each in (*first, *later)}
    return tuple(found.values()) if len(found) > 1 else ()


def _with_model_chosen(first: _Result, full_scenes: ByTurn, config: Config
                       ) -> tuple[_Result, tuple[Candidate, ...]]:
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
    chosen, tried = _chosen([result for result in found if result is not None], config)
    model = type(chosen.fit.camera)
    if model is type(camera):
        return first, tried
    return _without_shutter(first, model, full_scenes, config) or first, tried


def _few(first: _Result, full_scenes: ByTurn, config: Config) -> tuple[_Result, ByTurn]:
    """Return the result, and the scenes as they were measured, with a part of the tracks."""
    wanted = config.intrinsics.first_tracks
    scenes = [subsample_tracks(scene, wanted) for scene in first.fit.scenes]
    return (replace(first, fit=replace(first.fit, scenes=scenes)),
            {turn: subsample_tracks(scene, wanted) for turn, scene in full_scenes.items()})


def _without_shutter(first: _Result, model: type[Camera], measured: ByTurn, config: Config
                     ) -> _Result | None:
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
    prior = _prior(found, config)
    left_s, sigma_s = readout(found.fit.scenes, found.fit.camera, found.fit.solver.loss_px, prior)
    return None if _is_rolling(left_s, sigma_s, config.intrinsics) else found


def _is_rolling(readout_s: float, sigma_s: float, config: IntrinsicsConfig) -> bool:
    """Return whether a readout is clear evidence of a rolling shutter."""
    return abs(readout_s) >= max(config.shutter_sigmas * sigma_s, config.least_readout_ms / 1e3)


def _leaves_more(result: _Result, config: Config) -> bool:
    """Return whether a wider model may foretell the turns clearly better."""
    camera = result.fit.camera
    if type(camera.widened()) is type(camera):
        return False
    if result.fit.readout_s:
        return abs(result.fit.readout_s) < SHORT_READOUT_S
    prior = _prior(result, config)
    gains = gain_of_wider_model(result.parts, prior, extra_sigma_of(camera))
    return is_clear(gains / track_inflation(pooled(result.parts, prior)),
                    config.intrinsics.least_gain)


def _refitted(first: _Result, model: type[Camera], full_scenes: ByTurn, config: Config
              ) -> _Result | None:
    """Return the result with another model, None where it does not explain all turns."""
    camera = first.fit.camera
    if type(camera) is not model:
        camera = as_model(camera, model)
    step1 = camera
    if model.ros_model == first.step1.ros_model:
        step1 = model.centred(camera.image_size, first.step1.fx, *first.step1.params[4:])
    scenes = retriangulate_all(first.fit.scenes, camera, config.scene)
    if len(scenes) < len(first.fit.scenes):
        return None
    fit = _step2(replace(first.fit, scenes=scenes, camera=camera), full_scenes, step1, config)
    if len(fit.scenes) < len(first.fit.scenes):
        return None
    return _Result(fit, step1, config.intrinsics)


def _chosen(results: Sequence[_Result], config: Config) -> tuple[_Result, tuple[Candidate, ...]]:
    """Return the result whose model foretells the turns best, and how the others compare.

    The simplest comes first; one with more parameters must be clearly better, and map rays
    differently by more than its sigma.
    """
    if len(results) == 1:
        return results[0], ()
    results = sorted(results, key=lambda result: len(result.fit.camera.names()))
    loss_px = min(result.fit.solver.loss_px for result in results)
    priors = [_prior(result, config) for result in results]
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
    return chosen, tuple(Candidate(
        result.fit.camera.model, sum(gains[best].values()) - sum(gains[n].values()),
        mapping_error(result.fit.camera, chosen.fit.camera))
        for n, result in enumerate(results))


def _prior(result: _Result, config: Config) -> Floats:
    """Return the prior's information (n, n) about the result's camera."""
    return prior_information(result.step1, config.intrinsics)


def _alike(larger: _Result, simpler: _Result, config: Config) -> bool:
    """Return whether two models map rays alike, as far as the turns can tell."""
    apart = mapping_error(larger.fit.camera, simpler.fit.camera)
    return apart is not None and apart < _picture_sigma(larger, config).rms


def _picture_sigma(result: _Result, config: Config, systematic: float = 1.0) -> PictureSigma:
    camera, prior = result.fit.camera, _prior(result, config)
    return picture_sigma(camera, result.parts, prior, floor_of(camera, config.intrinsics),
                         step_to_wider_model(result.parts, prior, extra_sigma_of(camera)),
                         systematic)


def _step1(full_scenes: ByTurn, start: Camera, config: Config, progress: Progress) -> _Fit:
    """Return the scenes adjusted with one focal length and distortion; the centre is held.

    A part of the tracks is enough to come near the result, and takes a third of the time.
    """
    settings = config.intrinsics
    solver = Solver(config.scene.loss_px, config.scene.iterations)
    reach = (start.fx / settings.focal_reach, start.fx * settings.focal_reach)
    few = [subsample_tracks(scene, settings.first_tracks) for scene in full_scenes.values()]
    camera = start
    for n in range(settings.rounds):
        progress('step 1: one focal length', n / settings.rounds)
        few, camera = adjust_step1(few, camera, solver, reach)
        few = retriangulate_all(few, camera, config.scene)
    kept = explained_by(few, full_scenes, camera, config)
    return _Fit([subsample_tracks(scene, settings.first_tracks) for scene in kept], camera, solver)


def _step2_roughly(first: _Fit, config: Config) -> _Fit:
    """Return the scenes adjusted with all parameters, the effect of a rolling shutter removed.

    Without clear evidence of a rolling shutter the readout is 0: readouts of less than 1 ms were
    measured with global shutters.
    """
    settings, solver = config.intrinsics, first.solver
    prior = prior_of(first.camera, settings, noise_in(first.scenes, first.camera, solver.loss_px))
    bounds = bounds_of(first.camera, settings)
    scenes, camera = adjust_step2(first.scenes, first.camera, solver, prior, bounds)
    measured = {scene.turn: scene for scene in scenes}
    total = 0.0
    for _ in range(settings.shutter_rounds):
        found, sigma = readout(scenes, camera, solver.loss_px, prior_information(camera, settings))
        if (abs(found) < sigma) if total else not _is_rolling(found, sigma, settings):
            break
        total += found
        scenes = _without_rolling_shutter(scenes, measured, camera, total, config)
        scenes, camera = adjust_step2(scenes, camera, solver, prior, bounds)
        scenes = retriangulate_all(scenes, camera, config.scene)
    return _Fit(scenes, camera, solver, total)


def _with_all_tracks(rough: _Fit, full_scenes: ByTurn, separate: Sequence[Scene], config: Config
                     ) -> _Fit:
    """Return the scenes with all their tracks, without those that the camera does not explain."""
    camera = rough.camera
    scenes = [with_poses_of(full_scenes[scene.turn], scene) for scene in rough.scenes]
    measured = {scene.turn: scene for scene in scenes}
    if rough.readout_s:
        # the shutter's displacements depend on the points: find these with a generous limit first
        generous = replace(config.scene,
                           error_px=config.scene.chain_error * camera.image_size[0])
        scenes = retriangulate_all(scenes, camera, generous)
        scenes = _without_rolling_shutter(scenes, measured, camera, rough.readout_s, config)
    else:
        scenes = retriangulate_all(scenes, camera, config.scene)
    scenes = explained_by(scenes, {scene.turn: scene for scene in scenes}, camera, config)
    return replace(rough, scenes=with_better_poses(scenes, separate, camera, config.scene))


def _step2(complete: _Fit, full_scenes: ByTurn, step1: Camera, config: Config,
           progress: Progress = lambda stage, done: None) -> _Fit:
    """Return the scenes adjusted with all parameters, within bounds and priors from step 1."""
    settings = config.intrinsics
    fit, bounds = complete, bounds_of(step1, settings)
    for n in range(settings.rounds):
        progress('step 2: all parameters', (n + 1) / (settings.rounds + 1))
        if n > 0:
            ready = _retriangulated(fit, full_scenes, step1, config)
            if not fit.readout_s and _changed(fit, ready) < settings.settled:
                break
            fit = ready
        solver = replace(fit.solver, loss_px=loss_px_of(fit.scenes, fit.camera, settings))
        prior = prior_of(step1, settings, noise_in(fit.scenes, fit.camera, solver.loss_px))
        scenes, camera = adjust_step2(fit.scenes, fit.camera, solver, prior, bounds)
        fit = replace(fit, scenes=scenes, camera=camera, solver=solver)
    return fit


def _retriangulated(fit: _Fit, full_scenes: ByTurn, step1: Camera, config: Config) -> _Fit:
    """Return the scenes triangulated anew, after the readout was measured once more."""
    if not fit.readout_s:
        return replace(fit, scenes=retriangulate_all(fit.scenes, fit.camera, config.scene))
    prior = prior_information(step1, config.intrinsics)
    step_s, _ = readout(fit.scenes, fit.camera, fit.solver.loss_px, prior)
    readout_s = fit.readout_s + step_s
    scenes = _without_rolling_shutter(fit.scenes, full_scenes, fit.camera, readout_s, config)
    return replace(fit, scenes=scenes, readout_s=readout_s)


def _without_rolling_shutter(scenes: Sequence[Scene], measured: ByTurn, camera: Camera,
                             readout_s: float, config: Config) -> list[Scene]:
    """Return the scenes triangulated from tracks with the rolling shutter's effect removed."""
    moved = [remove_rolling_shutter(scene, measured[scene.turn], camera, readout_s)
             for scene in scenes]
    return retriangulate_all(moved, camera, config.scene)


def _changed(before: _Fit, after: _Fit) -> float:
    """Return the share of the observations that are used in only one of the two."""
    used = {scene.turn: scene.structure.used for scene in after.scenes}
    if len(used) < len(before.scenes):
        return 1.0
    changed = sum(int(np.sum(scene.structure.used != used[scene.turn]))
                  for scene in before.scenes)
    return changed / sum(int(scene.structure.used.sum()) for scene in before.scenes)


def _solution(result: _Result, separate: Sequence[Scene], profiles: tuple[Profile, Profile],
              tried: tuple[Candidate, ...], config: Config) -> Solution:
    """Return the solution with its covariance. profiles: the coarse one, and that around it."""
    settings = config.intrinsics
    final, step1, parts = result.fit, result.step1, result.parts
    scenes, camera, readout_s = final.scenes, final.camera, final.readout_s
    prior = prior_information(step1, settings)
    count = len(prior)
    departed = result.departures()
    systematic = max(1.0, *(each.strength for each in departed))
    spread = covariance(parts, prior, extra_sigma_of(camera), systematic)
    floor = floor_of(camera, settings)
    return Solution(
        camera=camera, covariance=spread[:count, :count] + np.diag(floor**2), step1=step1,
        scenes=tuple(scenes), parts=parts, coarse=profiles[0], around=profiles[1],
        bounds=np.array(bounds_of(step1, settings)), prior_information=prior, readout_s=readout_s,
        readout_sigma_s=float(np.sqrt(spread[count, count])) if readout_s else 0.0,
        misfits=misfits(separate, scenes, camera, config.scene.error_px), tried=tried,
        picture=_picture_sigma(result, config, systematic), departures=departed,
        crops=final.crops)
