"""What the turns say of the focal length: where to begin, and what it costs to be elsewhere."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dashcalib_ros.config import IntrinsicsConfig, SceneConfig
from dashcalib_ros.intrinsics.fitting import again, every
from dashcalib_ros.reconstruction.adjust import Solver, adjust_step1
from dashcalib_ros.reconstruction.build import chain_scene
from dashcalib_ros.reconstruction.camera import Camera
from dashcalib_ros.reconstruction.scene import Profile, Scene, truncated_cost

# the focal length is held at these times the result to see what the turns know of it
PROBES = (0.8, 1.0, 1.25)


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


def nearest_start(scenes: Sequence[Scene], profile: Profile) -> Camera:
    """Return the scene's own camera that lies nearest to the summed profile's minimum."""
    wanted = np.log(profile.best * scenes[0].camera.image_size[0])
    return min((scene.camera for scene in scenes),
               key=lambda camera: abs(float(np.log(camera.fx)) - wanted))


def profile_around(scenes: Sequence[Scene], camera: Camera, coarse: Profile,
                   config: IntrinsicsConfig, scene_config: SceneConfig, seed: int) -> Profile:
    """Return the cost with the focal length held at PROBES times the result, all else adjusted.

    Started from the result, with a part of the tracks: it costs an adjustment each. Where the
    coarse profile has its minimum elsewhere, that focal length is probed too, from a chain of its
    own: whichever explains more observations is right.
    """
    few = [every(scene, config.profile_tracks) for scene in scenes]
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
        moved = [again(scene, camera, config) for scene in moved]
        costs.append(cost(moved, camera))
    return min(costs)
