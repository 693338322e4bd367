"""The focal profile of all turns: where to start, and how the cost rises around the result."""
from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dashcalib_ros.camera import Camera
from dashcalib_ros.config import Config, SceneConfig
from dashcalib_ros.reconstruct.adjust import ROUGH, Solver, adjust
from dashcalib_ros.reconstruct.scene import Profile, Scene, truncated_cost
from dashcalib_ros.solve.fitting import rechain, retriangulate, subsample_tracks

# factors of the resulting focal length at which the profile is evaluated
PROBES = (0.8, 1.0, 1.25)
# where another probe's cost is higher by less than this share, so many times the tracks are used
CLOSE, MORE = 0.1, 4


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


def kinds_of_lenses(scenes: Sequence[Scene]) -> list[str]:
    """Return the families of the cameras that were tried for at least half of the scenes.

    The profiles do not decide between them: with two coefficients of distortion, wide lenses of
    one kind may look more like the other.
    """
    counts = Counter(kind for scene in scenes for kind in scene.starts)
    return [kind for kind, count in counts.items() if 2 * count >= len(scenes)]


def nearest_start(cameras: Sequence[Camera], profile: Profile) -> Camera:
    """Return the camera that is nearest to the summed profile's minimum."""
    wanted = np.log(profile.best * cameras[0].image_size[0])
    return min(cameras, key=lambda camera: abs(float(np.log(camera.fx)) - wanted))


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
    """Return profile_around() of these tracks."""
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
        anew = [rechain(scene, fixed, settings, config.seed) or scene for scene in scenes]
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
        solver = Solver(loss_px, config.iterations, ROUGH)
        moved, camera = adjust(moved, camera, solver, 'distortion')
        moved = [retriangulate(scene, camera, config) for scene in moved]
        costs.append(cost(moved, camera))
    return min(costs)
