"""How scenes come to a common camera: triangulated again, chained anew, given old poses."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from dashcalib_ros.config import SceneConfig
from dashcalib_ros.intrinsics.agreement import misfits
from dashcalib_ros.reconstruction.adjust import Solver, adjust_step1
from dashcalib_ros.reconstruction.build import chain_scene
from dashcalib_ros.reconstruction.camera import Camera
from dashcalib_ros.reconstruction.scene import Scene, retriangulated, truncated_cost


def again(scene: Scene, camera: Camera, config: SceneConfig) -> Scene:
    """Return the scene with its tracks triangulated anew."""
    return retriangulated(scene, camera, config.error_px, config.min_angle_deg)


def all_again(scenes: Sequence[Scene], camera: Camera, config: SceneConfig) -> list[Scene]:
    """Return the scenes with their tracks triangulated anew, those of which something is left."""
    found = [again(scene, camera, config) for scene in scenes]
    return [scene for scene in found if scene.structure.used.any()]


def every(scene: Scene, wanted: int) -> Scene:
    """Return the scene with only as many of its tracks."""
    chosen = np.unique(np.linspace(0, scene.tracks.xy.shape[1] - 1, wanted).astype(int))
    structure = scene.structure
    return replace(
        scene, tracks=replace(scene.tracks, xy=scene.tracks.xy[:, chosen]),
        structure=replace(structure, points=structure.points[chosen],
                          used=structure.used[:, chosen]))


def posed_as(scene: Scene, part: Scene) -> Scene:
    """Return the scene with the poses that a part of its tracks has led to."""
    structure = part.structure
    return replace(scene, camera=part.camera, structure=replace(
        scene.structure, rotations=structure.rotations, translations=structure.translations,
        registered=structure.registered))


def brought_to(scene: Scene, camera: Camera, config: SceneConfig, seed: int) -> Scene:
    """Return the scene, chained anew if its own focal length is far from the common one."""
    if abs(np.log(scene.camera.fx / camera.fx)) > np.log(1.08):
        anew = chain_scene(scene.tracks, scene.center, camera, scene.profile, config, seed)
        if anew is not None:
            return anew
    return again(scene, camera, config)


def explained_by(scenes: Sequence[Scene], whole: Mapping[int, Scene], camera: Camera,
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
    return again(scene, camera, config) if anew is None else _settled(anew, camera, config)


def mended(scenes: Sequence[Scene], alone: Sequence[Scene], camera: Camera, config: SceneConfig
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
    [moved], _ = adjust_step1([again(scene, camera, config)], camera, solver, None)
    return again(moved, camera, config)
