# SPDX-License-Identifier: Apache-2.0
"""A turn becomes a scene: its focal profile first, then one scene from the best start."""
from __future__ import annotations

from dataclasses import replace

from dashcalib_ros.arrays import Mask
from dashcalib_ros.camera import Camera, searched
from dashcalib_ros.config import Config
from dashcalib_ros.detect.turn import Turn, TurnId
from dashcalib_ros.reconstruct.adjust import Solver, refined
from dashcalib_ros.reconstruct.chain import chain_scene
from dashcalib_ros.reconstruct.focal_profile import best_trial
from dashcalib_ros.reconstruct.register import register_tracks
from dashcalib_ros.reconstruct.scene import (
    MIN_KEYFRAMES,
    Draft,
    Profile,
    Scene,
    Start,
    retriangulated,
    truncated_cost,
)
from dashcalib_ros.reconstruct.tracks import longest, spread, thinned, track_turn

# focal length / width; a lens that seems longer has 90 degrees across, or less, or it is a fisheye
# that a pinhole explains badly: those of 130 degrees and more cost 1.7 px^2 per observation
WIDE, LEAVES_MUCH = 0.5, 1.5
# a turn with fewer tracks is not tried
MIN_TRACKS = 80


def draft_scene(turn: Turn, config: Config, valid: Mask | None = None) -> Draft | None:
    """Track a turn and find the focal length to start from; None when none gives a scene.

    valid: (h, w), False where the ego vehicle is.
    """
    tracks, settings = track_turn(turn, config.tracks, valid), config.scene
    if tracks.xy.shape[1] < MIN_TRACKS or len(tracks.frames) < MIN_KEYFRAMES:
        return None
    found: list[Scene] = []
    for model in searched(config.model):
        if found and not _may_be_another(found[0].profile):
            break
        scene = best_trial(tracks, turn.id, config, model)
        if scene is not None:
            found.append(scene)
    if not found:
        return None
    if len(found) > 1:
        # at the focal lengths of the grid, the right kind may look worse
        found = [refined(scene, settings, _around(scene.camera), Solver.tolerance)
                 for scene in found]
    # min() returns the first one of equals: the simplest
    best = min(found, key=lambda scene: truncated_cost(scene, scene.camera, settings.error_px))
    return Draft(thinned(tracks, settings.keyframes), Start(best.profile, best.camera),
                 tuple(Start(scene.profile, scene.camera) for scene in found if scene is not best))


def _around(camera: Camera) -> tuple[float, float]:
    """Return the focal lengths between which the minimum may lie: the profile's grid is coarse."""
    return camera.fx / 1.3, camera.fx * 1.3


def _may_be_another(profile: Profile) -> bool:
    """Return whether a pinhole's profile leaves it open that the lens is a fisheye."""
    return profile.best < WIDE or float(profile.costs.min()) > LEAVES_MUCH


def finish_scene(turn: Turn, draft: Draft, config: Config) -> Scene | None:
    """Reconstruct a turn from its draft; None when that gives no scene.

    turn: needs the images of the draft's keyframes only.
    """
    start, settings = draft.start.camera, config.scene
    scene = _begun(draft, turn.id, config)
    if scene is None:
        return None
    scene, reach = replace(scene, rivals=draft.rivals), _around(start)
    scene = refined(scene, settings, reach)
    by_index = {frame.index: frame.image for frame in turn.frames}
    images = [by_index[int(index)] for index in scene.tracks.frames]
    registered = register_tracks(scene.tracks, scene.structure, scene.camera, images)
    scene = retriangulated(replace(scene, tracks=registered), scene.camera,
                           settings.error_px, settings.min_angle_deg)
    scene = refined(scene, settings, reach, Solver.tolerance)
    return scene if scene.structure.used.any() else None


def _begun(draft: Draft, turn: TurnId, config: Config) -> Scene | None:
    """Return a first scene from spread tracks, or from the longest if images are left out.

    Where tracks are short, no pair of images may share enough spread ones, or the chain breaks.
    """
    found = []
    for choose in (spread, longest):
        scene = chain_scene(choose(draft.tracks, config.scene.tracks), turn, draft.start.camera,
                            draft.start.profile, config)
        if scene is not None:
            found.append(scene)
            if scene.structure.registered.all():
                break
    return max(found, key=lambda scene: int(scene.structure.registered.sum()), default=None)
