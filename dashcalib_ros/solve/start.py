# SPDX-License-Identifier: Apache-2.0
"""Where the one problem starts: kinds of lenses, focal profiles, turns chained anew.

A turn was reconstructed with a camera of its own. Here it is brought to a common one, and a focal
length is held to see how the cost rises around the result. Scenes are given as a lens sees them:
nothing here knows about shutters and fields.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from dashcalib_ros.camera import Camera
from dashcalib_ros.config import Config, SceneConfig
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.reconstruct.adjust import MAX_ITERATIONS, ROUGH, Solver, adjust
from dashcalib_ros.reconstruct.chain import CHAIN_ERROR, chain_scene
from dashcalib_ros.reconstruct.scene import (
    Profile,
    Scene,
    errors_px,
    retriangulated,
    truncated_cost,
)
from dashcalib_ros.solve.optimise import loss_px_of, subsample_tracks

# factors of the resulting focal length at which the profile is evaluated
PROBES = (0.8, 1.0, 1.25)
# where another probe's cost is higher by less than this share, so many times the tracks are used
CLOSE, MORE = 0.1, 4
# px^2; lower costs count as this, so that the ratio of two tiny costs is near 1
LEAST_COST = 0.01
# of an adjustment with a fixed camera; it moves poses and points only, and is cheap
ITERATIONS = 20
ROUNDS = 3
# of a turn's observations; with fewer it is chained anew with the common camera
WELL_EXPLAINED = 0.9
# times a turn's cost with its own camera; above it, its own poses are tried, too
WELL_FITTING = 1.25


def kinds_of_lenses(scenes: Sequence[Scene]) -> list[str]:
    """Return the families of the cameras that were tried for at least half of the scenes.

    The profiles do not decide between them: with two coefficients of distortion, wide lenses of
    one kind may look more like the other.
    """
    counts = Counter(kind for scene in scenes for kind in scene.starts)
    return [kind for kind, count in counts.items() if 2 * count >= len(scenes)]


def summed(profiles: Sequence[Profile]) -> Profile:
    """Return the profiles' sum, in squared error times observations, on a common fine grid.

    A profile that tells nothing would outvote gentle bends; it counts only where all are like it.
    """
    profiles = [profile for profile in profiles if profile.tells] or profiles
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


def nearest_start(cameras: Sequence[Camera], profile: Profile) -> Camera:
    """Return the camera that is nearest to the summed profile's minimum."""
    wanted = np.log(profile.best * cameras[0].image_size[0])
    return min(cameras, key=lambda camera: abs(float(np.log(camera.fx)) - wanted))


def retriangulate(scene: Scene, camera: Camera, config: SceneConfig) -> Scene:
    """Return the scene with its tracks triangulated anew."""
    return retriangulated(scene, camera, config.error_px, config.min_angle_deg)


def rechain(scene: Scene, camera: Camera, config: Config) -> Scene | None:
    """Return the scene chained anew from its tracks, None if no pair of images starts a chain."""
    return chain_scene(scene.tracks, scene.turn, camera, scene.profile, config)


def with_poses_of(scene: Scene, part: Scene) -> Scene:
    """Return the scene with the poses and the camera of part, the same scene with fewer tracks."""
    structure = part.structure
    return replace(scene, camera=part.camera, structure=replace(
        scene.structure, rotations=structure.rotations, translations=structure.translations,
        registered=structure.registered))


def is_far(scene: Scene, camera: Camera) -> bool:
    """Return whether a scene's own camera is so far from this one that its poses may be wrong."""
    far = abs(np.log(scene.camera.fx / camera.fx)) > np.log(1.08)
    return bool(far or scene.camera.family != camera.family)


def adapted_to(scene: Scene, camera: Camera, config: Config) -> Scene:
    """Return the scene with this camera, chained anew if its own camera was far from it."""
    if is_far(scene, camera):
        anew = rechain(scene, camera, config)
        if anew is not None:
            return anew
    return retriangulate(scene, camera, config.scene)


def explained_by(scenes: Sequence[Scene], measured: Mapping[TurnId, Scene], camera: Camera,
                 config: Config) -> list[Scene]:
    """Return the scenes that the camera explains, some of them chained anew with it.

    measured: the scenes with all their tracks, by turn: a chain of few tracks soon breaks. The
    first chain of a scene may be broken in its middle, as the lens was unknown then.
    """
    kept = []
    for scene in scenes:
        if scene.explained < WELL_EXPLAINED:
            scene = max(scene, _rechained(measured[scene.turn], camera, config),
                        key=lambda candidate: candidate.explained)
        if scene.explained >= config.scene.min_explained:
            kept.append(scene)
    return kept


def _rechained(scene: Scene, camera: Camera, config: Config) -> Scene:
    anew = rechain(scene, camera, config)
    return (retriangulate(scene, camera, config.scene) if anew is None
            else _readjusted(anew, camera, config.scene))


def with_better_poses(scenes: Sequence[Scene], per_turn: Sequence[Scene], camera: Camera,
                      config: SceneConfig) -> list[Scene]:
    """Return the scenes, with their poses from per_turn where these explain clearly more.

    The first steps use a part of the tracks only: the pose of an image that sees few of them may
    be wrong.
    """
    found = misfits(per_turn, scenes, camera, config.error_px)
    own = {scene.turn: scene.structure for scene in per_turn}

    def cost(scene: Scene) -> float:
        return truncated_cost(scene, camera, config.error_px)

    return [min(scene, _readjusted(replace(scene, structure=own[scene.turn]), camera, config),
                key=cost) if found[scene.turn] > WELL_FITTING else scene
            for scene in scenes]


def _readjusted(scene: Scene, camera: Camera, config: SceneConfig) -> Scene:
    # the focal length is fixed; the distortion that is found is not used
    solver = Solver(0.01 * camera.image_size[0], MAX_ITERATIONS)
    [moved], _ = adjust([retriangulate(scene, camera, config)], camera, solver, 'distortion')
    return retriangulate(moved, camera, config)


def misfits(per_turn: Sequence[Scene], together: Sequence[Scene], camera: Camera, limit_px: float
            ) -> dict[TurnId, float]:
    """Return the ratio of each turn's cost with the shared camera to that with its own, by turn.

    per_turn: the turns as they were reconstructed, each with its own camera (one focal length,
    k1, k2). together: those that are left, adjusted with the shared camera. limit_px: larger
    errors count as this. Costs are means over all observations, also of points that are too far
    away to be used. The ratio is about 1 or less for a turn of the shared camera; a turn that is
    not in together costs limit_px squared.
    """
    adjusted = {scene.turn: scene for scene in together}

    def cost(scene: Scene, camera: Camera) -> float:
        # at a fixed angle a shorter focal length has more points, and fewer errors only for that
        whole = retriangulated(scene, camera, limit_px, min_angle_deg=0.0)
        return max(truncated_cost(whole, camera, limit_px), LEAST_COST)

    return {scene.turn: (cost(adjusted[scene.turn], camera) if scene.turn in adjusted
                         else limit_px**2) / cost(scene, scene.camera) for scene in per_turn}


def costs_with(camera: Camera, scenes: Sequence[Scene], loss_px: float, limit_px: float
               ) -> list[float]:
    """Return what each scene costs with a fixed camera, px^2 for each observation it uses.

    loss_px: scale of the Cauchy loss. limit_px: larger errors, and points that the camera cannot
    see, count as this.
    """
    adjusted, _ = adjust(scenes, camera, Solver(loss_px, ITERATIONS), 'nothing')
    costs = []
    for scene in adjusted:
        errors = np.minimum(errors_px(scene, camera), limit_px)[scene.structure.used]
        costs.append(float(loss_px**2 * np.mean(np.log1p(errors**2 / loss_px**2))))
    return costs


def scene_with(camera: Camera, scene: Scene, config: Config) -> Scene | None:
    """Return the scene as a camera explains it; None where it explains no observation.

    It is triangulated, and also chained anew where its own camera is far from this one, and
    adjusted with that camera: the better one counts, as a chain may break where images are
    lost. The first rounds are generous: the camera may be wrong.
    """
    width = camera.image_size[0]
    generous = replace(config.scene, error_px=max(config.scene.error_px,
                                                  CHAIN_ERROR * width))
    anew = (rechain(scene, camera, replace(config, scene=generous)) if is_far(scene, camera)
            else None)
    found = [_with_fixed(camera, each, generous, config)
             for each in (scene, anew) if each is not None]
    return min((each for each in found if each is not None), default=None,
               key=lambda each: truncated_cost(each, camera, config.scene.error_px))


def _with_fixed(camera: Camera, found: Scene, generous: SceneConfig, config: Config
                ) -> Scene | None:
    for n in range(ROUNDS):
        limits = generous if n < ROUNDS - 1 else config.scene
        found = retriangulate(found, camera, limits)
        if not found.structure.used.any():
            return None
        loss_px = loss_px_of([found], camera, config.intrinsics)
        [found], _ = adjust([found], camera, Solver(loss_px, ITERATIONS), 'nothing')
    return found


def profile_around(scenes: Sequence[Scene], camera: Camera, coarse: Profile,
                   config: Config) -> Profile:
    """Return the cost with the focal length fixed at PROBES times the result, all else adjusted.

    Each probe is an adjustment that starts from the result, with a part of the tracks, and with
    more of them where it is close: few points hold a turn's poses badly. The least triangulation
    angle is the same in pixels for all: at a fixed angle a shorter focal length would have more
    points, and explain more observations only for that. If the coarse profile has its minimum
    outside the probes, that focal length is probed too, with scenes chained anew: of the two, the
    one that explains more observations is right.
    """
    def probed(tracks: int) -> Profile:
        few = [subsample_tracks(scene, tracks) for scene in scenes]
        return _probed(few, camera, coarse, config)

    wanted = config.intrinsics.profile_tracks
    found = probed(wanted)
    close = found.contrast(camera.fx / camera.image_size[0]) < CLOSE
    return probed(MORE * wanted) if close else found


def _probed(scenes: Sequence[Scene], camera: Camera, coarse: Profile, config: Config) -> Profile:
    def settings_at(fixed: Camera) -> SceneConfig:
        least = config.scene.min_angle_deg * camera.fx / fixed.fx
        return replace(config.scene, min_angle_deg=least)

    width = camera.image_size[0]
    costs = {}
    for probe in PROBES:
        fixed = camera.with_focal(camera.fx * probe)
        costs[fixed.fx / width] = _cost_at(scenes, fixed, settings_at(fixed))
    if not PROBES[0] < coarse.best * width / camera.fx < PROBES[-1]:
        fixed = type(camera).centred(camera.image_size, coarse.best * width)
        settings = settings_at(fixed)
        anew = [rechain(scene, fixed, replace(config, scene=settings)) or scene
                for scene in scenes]
        costs[coarse.best] = _cost_at(anew, fixed, settings)
    ratios = sorted(costs)
    observations = sum(int(scene.tracks.seen.sum()) for scene in scenes)
    return Profile(np.array(ratios), np.array([costs[ratio] for ratio in ratios]), observations)


def _cost_at(scenes: Sequence[Scene], camera: Camera, config: SceneConfig) -> float:
    """Return the truncated cost over all scenes after adjusting all but the focal length, px^2.

    The lowest cost met on the way: the wide loss may lead away from a start that is right.
    """
    def cost(moved: Sequence[Scene], camera: Camera) -> float:
        return float(np.average([truncated_cost(scene, camera, config.error_px)
                                 for scene in moved],
                                weights=[int(scene.tracks.seen.sum()) for scene in moved]))

    moved = list(scenes)
    costs = [cost(moved, camera)]
    # the first residuals are large: the loss must be as wide, or it ignores them
    for loss_px in (0.01 * camera.image_size[0], config.loss_px):
        solver = Solver(loss_px, MAX_ITERATIONS, ROUGH)
        moved, camera = adjust(moved, camera, solver, 'distortion')
        moved = [retriangulate(scene, camera, config) for scene in moved]
        costs.append(cost(moved, camera))
    return min(costs)
