"""Scenes -> one camera, in the paper's two steps (3.2), with what each turn knows of it."""
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from dashcalib_ros.config import IntrinsicsConfig, SceneConfig
from dashcalib_ros.intrinsics.agreement import misfits
from dashcalib_ros.intrinsics.information import covariance, information, noise_in
from dashcalib_ros.intrinsics.shutter import readout, row_shift, undone
from dashcalib_ros.intrinsics.solution import Solution
from dashcalib_ros.reconstruction.adjust import Prior, Solver, adjust_step1, adjust_step2
from dashcalib_ros.reconstruction.build import chain_scene
from dashcalib_ros.reconstruction.camera import Camera
from dashcalib_ros.reconstruction.scene import (
    Profile,
    Scene,
    errors_px,
    retriangulated,
    truncated_cost,
)

Array = npt.NDArray[np.float64]
# the focal length is held at these times the result to see what the turns know of it
PROBES = (0.8, 1.0, 1.25)
# rendered images without noise would make the loss cut off everything
LEAST_LOSS_PX = 0.05
Progress = Callable[[str, float], None]


def solve(alone: Sequence[Scene], config: IntrinsicsConfig, scene_config: SceneConfig,
          seed: int = 0, progress: Progress = lambda stage, done: None) -> Solution | None:
    """Adjust all scenes with one shared camera.

    alone: at least one scene, each as its turn was reconstructed. The summed focal profile picks
    the start; a scene that was built far from it is chained anew, and one that the shared camera
    does not explain is dropped. None when that becomes of all.
    """
    profile = summed([scene.profile for scene in alone])
    start = _start(alone, profile)
    # a part of the tracks is enough to come near the result, at a third of the time
    scenes = [_brought_to(scene, start, scene_config, seed) for scene in alone]
    whole = {scene.center: scene for scene in scenes}
    few = [_every(scene, config.first_tracks) for scene in scenes]
    solver = Solver(scene_config.loss_px, scene_config.iterations)
    reach = (start.fx / config.focal_reach, start.fx * config.focal_reach)
    camera = start
    for n in range(config.rounds):
        progress('step 1: one focal length', n / config.rounds)
        few, camera = adjust_step1(few, camera, solver, reach)
        few = _all_again(few, camera, scene_config)
    few = [_every(scene, config.first_tracks) for scene in _explained(
        few, whole, camera, scene_config, seed)]
    if not few:
        return None
    step1 = camera
    prior = _prior(step1, config, noise_in(few, camera, solver.loss_px))
    bounds = _bounds(step1, config)
    progress('step 2: all six', 0.0)
    few, camera = adjust_step2(few, camera, solver, prior, bounds)
    few, camera, readout_s = _shutter(few, camera, solver, prior, bounds, config, scene_config)
    together = _without_shutter([_posed_as(whole[scene.center], scene) for scene in few], camera,
                                readout_s, scene_config)
    together = _explained(together, {scene.center: scene for scene in together}, camera,
                          scene_config, seed)
    together = _mended(together, alone, camera, scene_config)
    if not together:
        return None
    for n in range(config.rounds):
        progress('step 2: all six', (n + 1) / (config.rounds + 1))
        solver = replace(solver, loss_px=_loss_px(together, camera, config))
        prior = _prior(step1, config, noise_in(together, camera, solver.loss_px))
        together, camera = adjust_step2(together, camera, solver, prior, bounds)
        if n < config.rounds - 1:
            if readout_s:
                readout_s += readout(together, camera, solver.loss_px, _belief(step1, config))[0]
                together = _undone(together, whole, camera, readout_s)
            together = _all_again(together, camera, scene_config)
    progress('sigma', 0.0)
    parts = tuple(information(scene, camera, solver.loss_px,
                              row_shift(scene, camera) if readout_s else None)
                  for scene in together)
    spread = covariance(parts, _belief(step1, config))
    readout_sigma_s = float(np.sqrt(spread[6, 6])) if readout_s else 0.0
    spread = spread[:6, :6] + np.diag(np.square(
        [config.focal_floor * camera.fx] * 2
        + [config.centre_floor * camera.image_size[0]] * 2 + [0.0] * 2))
    progress('focal profile', 0.0)
    around = _profile_around(together, camera, profile, config, scene_config, seed)
    return Solution(camera, spread, step1, tuple(together), parts, profile, around,
                    np.array(bounds), readout_s, readout_sigma_s,
                    misfits(alone, together, camera, scene_config.error_px))


def _shutter(scenes: list[Scene], camera: Camera, solver: Solver, prior: Prior,
             bounds: tuple[Array, Array], config: IntrinsicsConfig, scene_config: SceneConfig
             ) -> tuple[list[Scene], Camera, float]:
    """Return the scenes as a global shutter would have seen them, the camera, and the readout, s.

    Without clear evidence of a rolling shutter all is as it was, and the readout 0: the global
    shutters at hand were measured within 1 ms of that.
    """
    measured = {scene.center: scene for scene in scenes}
    total = 0.0
    for _ in range(config.shutter_rounds):
        found, sigma = readout(scenes, camera, solver.loss_px, _belief(camera, config))
        if abs(found) < (sigma if total else max(config.shutter_sigmas * sigma,
                                                 config.least_readout_ms / 1e3)):
            break
        total += found
        scenes = _undone(scenes, measured, camera, total)
        scenes = _all_again(scenes, camera, scene_config)
        scenes, camera = adjust_step2(scenes, camera, solver, prior, bounds)
        scenes = _all_again(scenes, camera, scene_config)
    return scenes, camera, total


def _without_shutter(scenes: Sequence[Scene], camera: Camera, readout_s: float,
                     config: SceneConfig) -> list[Scene]:
    """Return scenes that have poses triangulated, where a rolling shutter left its marks, too."""
    if not readout_s:
        return _all_again(scenes, camera, config)
    # until the points are known, nobody knows how far the shutter has displaced them
    generous = replace(config, error_px=config.chain_error * camera.image_size[0])
    rough = _all_again(scenes, camera, generous)
    return _all_again(_undone(rough, {scene.center: scene for scene in scenes}, camera, readout_s),
                      camera, config)


def _undone(scenes: Sequence[Scene], measured: Mapping[int, Scene], camera: Camera,
            readout_s: float) -> list[Scene]:
    return [undone(scene, measured[scene.center], camera, readout_s) for scene in scenes]


def _belief(camera: Camera, config: IntrinsicsConfig) -> Array:
    """Return the prior's information (6, 6) at unit noise."""
    return np.asarray(np.linalg.inv(_prior(camera, config, 1.0).covariance), np.float64)


def _loss_px(scenes: Sequence[Scene], camera: Camera, config: IntrinsicsConfig) -> float:
    """Return the scale of the Cauchy loss: as wide as this drive's residuals are."""
    errors = np.concatenate([errors_px(scene, camera)[scene.structure.used] for scene in scenes])
    return max(config.loss * float(np.median(errors)), LEAST_LOSS_PX)


def _posed_as(scene: Scene, part: Scene) -> Scene:
    """Return the scene with the poses that a part of its tracks has led to."""
    structure = part.structure
    return replace(scene, camera=part.camera, structure=replace(
        scene.structure, rotations=structure.rotations, translations=structure.translations,
        registered=structure.registered))


def _profile_around(scenes: Sequence[Scene], camera: Camera, coarse: Profile,
                    config: IntrinsicsConfig, scene_config: SceneConfig, seed: int) -> Profile:
    """Return the cost with the focal length held at PROBES times the result, all else adjusted.

    Started from the result, with a part of the tracks: it costs an adjustment each. Where the
    coarse profile has its minimum elsewhere, that focal length is probed too, from a chain of its
    own: whichever explains more observations is right.
    """
    few = [_every(scene, config.profile_tracks) for scene in scenes]
    width = camera.image_size[0]
    costs = {}
    for probe in PROBES:
        held = replace(camera, fx=camera.fx * probe, fy=camera.fx * probe)
        costs[held.fx / width] = _held_cost(few, held, scene_config)
    if not PROBES[0] < coarse.best * width / camera.fx < PROBES[-1]:
        held = Camera.centred(camera.image_size, coarse.best * width)
        anew = [chain_scene(scene.tracks, scene.center, held, scene.profile, scene_config, seed)
                or scene for scene in few]
        costs[coarse.best] = _held_cost(anew, held, scene_config)
    ratios = sorted(costs)
    observations = sum(int(scene.tracks.seen.sum()) for scene in few)
    return Profile(np.array(ratios), np.array([costs[ratio] for ratio in ratios]), observations)


def _held_cost(scenes: Sequence[Scene], camera: Camera, config: SceneConfig) -> float:
    """Return the truncated cost over all scenes after adjusting all but the focal length, px^2.

    The least of what is met on the way: where the scenes lie already, the wide loss leads away.
    """
    def cost(moved: Sequence[Scene], camera: Camera) -> float:
        return float(np.average([truncated_cost(scene, camera, config.error_px)
                                 for scene in moved],
                                weights=[int(scene.tracks.seen.sum()) for scene in moved]))

    moved = list(scenes)
    costs = [cost(moved, camera)]
    # the first residuals are large: a loss as wide as they are brings the poses along
    for loss_px in (0.01 * camera.image_size[0], config.loss_px, config.loss_px):
        moved, camera = adjust_step1(moved, camera, Solver(loss_px, config.iterations), None)
        moved = [_again(scene, camera, config) for scene in moved]
        costs.append(cost(moved, camera))
    return min(costs)


def _every(scene: Scene, wanted: int) -> Scene:
    """Return the scene with only as many of its tracks."""
    chosen = np.unique(np.linspace(0, scene.tracks.xy.shape[1] - 1, wanted).astype(int))
    structure = scene.structure
    return replace(
        scene, tracks=replace(scene.tracks, xy=scene.tracks.xy[:, chosen]),
        structure=replace(structure, points=structure.points[chosen],
                          used=structure.used[:, chosen]))


def summed(profiles: Sequence[Profile]) -> Profile:
    """Return the profiles' sum, in squared error times observations, on a common fine grid."""
    low = max(profile.ratios[0] for profile in profiles)
    high = min(profile.ratios[-1] for profile in profiles)
    if low >= high:
        low, high = (min(profile.ratios[0] for profile in profiles),
                     max(profile.ratios[-1] for profile in profiles))
    ratios = np.geomspace(low, high, 81)
    total = np.zeros(len(ratios))
    for profile in profiles:
        total += profile.observations * np.interp(
            np.log(ratios), np.log(profile.ratios), profile.costs)
    observations = sum(profile.observations for profile in profiles)
    return Profile(ratios, total / observations, observations)


def _start(scenes: Sequence[Scene], profile: Profile) -> Camera:
    """Return the scene's own camera that lies nearest to the summed profile's minimum."""
    wanted = np.log(profile.best * scenes[0].camera.image_size[0])
    return min((scene.camera for scene in scenes),
               key=lambda camera: abs(float(np.log(camera.fx)) - wanted))


def _brought_to(scene: Scene, camera: Camera, config: SceneConfig, seed: int) -> Scene:
    """Return the scene, chained anew if its own focal length is far from the common one."""
    if abs(np.log(scene.camera.fx / camera.fx)) > np.log(1.08):
        anew = chain_scene(scene.tracks, scene.center, camera, scene.profile, config, seed)
        if anew is not None:
            return anew
    return _again(scene, camera, config)


def _all_again(scenes: Sequence[Scene], camera: Camera, config: SceneConfig) -> list[Scene]:
    again = [_again(scene, camera, config) for scene in scenes]
    return [scene for scene in again if scene.structure.used.any()]


def _explained(scenes: Sequence[Scene], whole: Mapping[int, Scene], camera: Camera,
               config: SceneConfig, seed: int) -> list[Scene]:
    """Return the scenes that the camera explains, some of them chained anew with it.

    whole: the scenes with all their tracks, by centre: a chain of a few of them soon breaks.
    A chain that was built without knowing the lens may be broken in its middle.
    """
    kept = []
    for scene in scenes:
        if scene.explained < config.well_explained:
            scene = max(scene, _anew(whole[scene.center], camera, config, seed),
                        key=lambda candidate: candidate.explained)
        if scene.explained >= config.min_explained:
            kept.append(scene)
    return kept


def _anew(scene: Scene, camera: Camera, config: SceneConfig, seed: int) -> Scene:
    """Return the scene chained anew with a camera that is nearly right, if that can be done."""
    anew = chain_scene(scene.tracks, scene.center, camera, scene.profile, config, seed)
    return _again(scene, camera, config) if anew is None else _settled(anew, camera, config)


def _mended(scenes: Sequence[Scene], alone: Sequence[Scene], camera: Camera, config: SceneConfig
            ) -> list[Scene]:
    """Return the scenes, with the poses they had alone where these explain clearly more.

    The first steps have a part of the tracks only: an image that sees few of them may go astray.
    """
    found = misfits(alone, scenes, camera, config.error_px)
    own = {scene.center: scene.structure for scene in alone}

    def cost(scene: Scene) -> float:
        return truncated_cost(scene, camera, config.error_px)

    return [min(scene, _settled(replace(scene, structure=own[scene.center]), camera, config),
                key=cost) if found[scene.center] > config.well_fitting else scene
            for scene in scenes]


def _settled(scene: Scene, camera: Camera, config: SceneConfig) -> Scene:
    """Return the scene adjusted to a camera that is nearly right."""
    # the centre and the aspect stay, the focal length is held
    solver = Solver(0.01 * camera.image_size[0], config.iterations)
    [moved], _ = adjust_step1([_again(scene, camera, config)], camera, solver, None)
    return _again(moved, camera, config)


def _again(scene: Scene, camera: Camera, config: SceneConfig) -> Scene:
    return retriangulated(scene, camera, config.error_px, config.min_angle_deg)


def _prior(camera: Camera, config: IntrinsicsConfig, noise: float) -> Prior:
    """Return square pixels and a centred principal point, as far as either is believed.

    noise: variance of a residual, px^2. The adjustment takes residuals in px as if their sigma
    were 1: the prior must be weakened by as much as they are more exact.
    """
    width, height = camera.image_size
    wide = (10 * camera.fx) ** 2
    spread = np.diag([wide, wide, (config.centre_sigma * width) ** 2,
                      (config.centre_sigma * width) ** 2, 1.0, 1.0])
    # fx may be anything; fy is fx to within the aspect's sigma
    spread[0, 1] = spread[1, 0] = wide
    spread[1, 1] += (config.aspect_sigma * camera.fx) ** 2
    mean = np.array([camera.fx, camera.fx, (width - 1) / 2, (height - 1) / 2, 0.0, 0.0])
    return Prior(mean, spread / noise)


def _bounds(camera: Camera, config: IntrinsicsConfig) -> tuple[Array, Array]:
    """Return the lowest and the highest values of step 2 (the paper: 'within bounds')."""
    width, height = camera.image_size
    middle = np.array([camera.fx, camera.fx, (width - 1) / 2, (height - 1) / 2, 0.0, 0.0])
    reach = np.array([camera.fx * config.focal_bound, camera.fx * config.focal_bound,
                      width * config.centre_bound, height * config.centre_bound,
                      config.k_bound, config.k_bound])
    return middle - reach, middle + reach
