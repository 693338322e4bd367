"""Scenes are fitted to a given camera: triangulated anew, chained anew, or given other poses."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from dashcalib_ros.camera import Camera
from dashcalib_ros.config import Config, SceneConfig
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.reconstruct.adjust import Solver, adjust_distortion
from dashcalib_ros.reconstruct.build import chain_scene
from dashcalib_ros.reconstruct.scene import Scene, retriangulated, truncated_cost
from dashcalib_ros.solve.misfit import misfits


def retriangulate(scene: Scene, camera: Camera, config: SceneConfig) -> Scene:
    """Return the scene with its tracks triangulated anew."""
    return retriangulated(scene, camera, config.error_px, config.min_angle_deg)


def retriangulate_all(scenes: Sequence[Scene], camera: Camera, config: SceneConfig) -> list[Scene]:
    """Return the scenes with their tracks triangulated anew; scenes without points are dropped."""
    found = [retriangulate(scene, camera, config) for scene in scenes]
    return [scene for scene in found if scene.structure.used.any()]


def rechain(scene: Scene, camera: Camera, config: Config) -> Scene | None:
    """Return the scene chained anew from its tracks, None if no pair of images starts a chain."""
    return chain_scene(
        scene.tracks, scene.turn, camera, scene.profile, config.scene, config.seed)


def subsample_tracks(scene: Scene, wanted: int) -> Scene:
    """Return the scene with at most this many of its tracks, evenly chosen."""
    chosen = np.unique(np.linspace(0, scene.tracks.xy.shape[1] - 1, wanted).astype(int))
    structure = scene.structure
    return replace(
        scene, tracks=replace(scene.tracks, xy=scene.tracks.xy[:, chosen]),
        structure=replace(structure, points=structure.points[chosen],
                          used=structure.used[:, chosen]))


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


def explained_by(scenes: Sequence[Scene], full_scenes: Mapping[TurnId, Scene], camera: Camera,
                 config: Config) -> list[Scene]:
    """Return the scenes that the camera explains, some of them chained anew with it.

    full_scenes: the scenes with all their tracks, by turn: a chain of few tracks soon breaks. The
    first chain of a scene may be broken in its middle, as the lens was unknown then.
    """
    kept = []
    for scene in scenes:
        if scene.explained < config.scene.well_explained:
            scene = max(scene, _rechained(full_scenes[scene.turn], camera, config),
                        key=lambda candidate: candidate.explained)
        if scene.explained >= config.scene.min_explained:
            kept.append(scene)
    return kept


def _rechained(scene: Scene, camera: Camera, config: Config) -> Scene:
    """Return the scene chained anew with a camera that is nearly right, else triangulated anew."""
    anew = rechain(scene, camera, config)
    return (retriangulate(scene, camera, config.scene) if anew is None
            else _readjusted(anew, camera, config.scene))


def with_better_poses(scenes: Sequence[Scene], separate: Sequence[Scene], camera: Camera,
                      config: SceneConfig) -> list[Scene]:
    """Return the scenes, with their poses from separate where these explain clearly more.

    The first steps use a part of the tracks only: the pose of an image that sees few of them may
    be wrong.
    """
    found = misfits(separate, scenes, camera, config.error_px)
    own = {scene.turn: scene.structure for scene in separate}

    def cost(scene: Scene) -> float:
        return truncated_cost(scene, camera, config.error_px)

    return [min(scene, _readjusted(replace(scene, structure=own[scene.turn]), camera, config),
                key=cost) if found[scene.turn] > config.well_fitting else scene
            for scene in scenes]


def _readjusted(scene: Scene, camera: Camera, config: SceneConfig) -> Scene:
    """Return the scene adjusted to a camera that is nearly right."""
    # the focal length is held; the distortion that is found is not used
    solver = Solver(0.01 * camera.image_size[0], config.iterations)
    [moved], _ = adjust_distortion([retriangulate(scene, camera, config)], camera, solver)
    return retriangulate(moved, camera, config)
