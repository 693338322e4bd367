"""Scenes are fitted to a given camera: triangulated or chained anew, given other poses, judged."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.config import Config, SceneConfig
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.reconstruct.adjust import Solver, adjust
from dashcalib_ros.reconstruct.chain import chain_scene
from dashcalib_ros.reconstruct.scene import Scene, errors_px, retriangulated, truncated_cost
from dashcalib_ros.solve.prior import loss_px_of

# px^2; lower costs count as this, so that the ratio of two tiny costs is near 1
LEAST_COST = 0.01
# of each turn, where a part of its tracks is enough
FIRST_TRACKS = 200
# of an adjustment with a fixed camera; it moves poses and points only, and is cheap
ITERATIONS = 20
ROUNDS = 3
# of points with fixed poses: Gauss-Newton steps, and the damping of their blocks
POINT_STEPS, POINT_DAMPING = 3, 1e-3
# of a turn's observations; with fewer it is chained anew with the common camera
WELL_EXPLAINED = 0.9
# times a turn's cost with its own camera; above it, its own poses are tried, too
WELL_FITTING = 1.25


def retriangulate(scene: Scene, camera: Camera, config: SceneConfig) -> Scene:
    """Return the scene with its tracks triangulated anew."""
    return retriangulated(scene, camera, config.error_px, config.min_angle_deg)


def retriangulate_all(scenes: Sequence[Scene], camera: Camera, config: SceneConfig) -> list[Scene]:
    """Return the scenes with their tracks triangulated anew; scenes without points are dropped."""
    found = [retriangulate(scene, camera, config) for scene in scenes]
    return [scene for scene in found if scene.structure.used.any()]


def with_points_settled(scene: Scene, camera: Camera, loss_px: float) -> Scene:
    """Return the scene with each used point where its observations ask for it; poses are fixed.

    Triangulation is linear and knows no loss: joint steps from its points lead astray.
    """
    structure, used = scene.structure, scene.structure.used
    rows, columns = np.nonzero(used)
    tracks, point = np.unique(columns, return_inverse=True)
    rotation, observed = structure.rotations[rows], scene.tracks.xy[rows, columns]

    def local(points: Floats) -> Floats:
        return np.asarray(np.einsum('nij,nj->ni', rotation, points[point])
                          + structure.translations[rows])

    def squares(points: Floats) -> Floats:
        off = camera.project(local(points)) - observed
        return np.asarray(np.sum(off**2, axis=1) / loss_px**2)

    def summed(values: Floats) -> Floats:
        columns = values.reshape(len(point), -1).T
        sums = np.stack([np.bincount(point, column) for column in columns], axis=1)
        return np.asarray(sums.reshape(-1, *values.shape[1:]), np.float64)

    points = structure.points[tracks]
    off = squares(points)
    for _ in range(POINT_STEPS):
        _, by_local, projected = camera.derivatives(local(points))
        by_point, residual = by_local @ rotation, observed - projected
        weighted = (by_point / (1 + off)[:, None, None]).transpose(0, 2, 1)
        blocks = summed(weighted @ by_point)
        # a badly determined point has a solution, too
        damping = (POINT_DAMPING * np.einsum('tii->ti', blocks)[:, :, None] + 1e-12) * np.eye(3)
        step = np.linalg.solve(blocks + damping, summed(weighted @ residual[:, :, None]))
        moved = points + step[:, :, 0]
        after = squares(moved)
        # NaN, of a point that has gone behind a camera, is no gain
        gains = summed(np.log1p(after)) < summed(np.log1p(off))
        points = np.where(gains[:, None], moved, points)
        off = np.where(gains[point], after, off)
    found = structure.points.copy()
    found[tracks] = points
    return replace(scene, structure=replace(structure, points=found))


def rechain(scene: Scene, camera: Camera, config: SceneConfig, seed: int) -> Scene | None:
    """Return the scene chained anew from its tracks, None if no pair of images starts a chain."""
    return chain_scene(scene.tracks, scene.turn, camera, scene.profile, config, seed)


def subsample_tracks(scene: Scene, wanted: int) -> Scene:
    """Return the scene with at most this many of its tracks, evenly chosen."""
    chosen = np.unique(np.linspace(0, scene.tracks.xy.shape[1] - 1, wanted).astype(int))
    structure = scene.structure
    return replace(
        scene, tracks=replace(scene.tracks, xy=scene.tracks.xy[:, chosen]),
        structure=replace(structure, points=structure.points[chosen],
                          used=structure.used[:, chosen]))


def with_few_tracks(scene: Scene) -> Scene:
    """Return the scene with a part of its tracks, enough for all but the result."""
    return subsample_tracks(scene, FIRST_TRACKS)


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
        anew = rechain(scene, camera, config.scene, config.seed)
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
    """Return the scene chained anew with a camera that is nearly right, else triangulated anew."""
    anew = rechain(scene, camera, config.scene, config.seed)
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
    """Return the scene adjusted to a camera that is nearly right."""
    # the focal length is fixed; the distortion that is found is not used
    solver = Solver(0.01 * camera.image_size[0], config.iterations)
    [moved], _ = adjust([retriangulate(scene, camera, config)], camera, solver, 'distortion')
    return retriangulate(moved, camera, config)


def misfits(per_turn: Sequence[Scene], together: Sequence[Scene], camera: Camera, limit_px: float
            ) -> dict[TurnId, float]:
    """Return the ratio of each turn's cost with the shared camera to that with its own, by turn.

    per_turn: the turns as they were reconstructed, each with its own camera (one focal length,
    k1, k2). together: those that are left, adjusted with the shared camera. limit_px: larger
    errors count as this. Costs are means over all observations. The ratio is about 1 or less for a
    turn of the shared camera; a turn that is not in together costs limit_px squared.
    """
    adjusted = {scene.turn: scene for scene in together}

    def cost(scene: Scene, camera: Camera) -> float:
        return max(truncated_cost(scene, camera, limit_px), LEAST_COST)

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
                                                  config.scene.chain_error * width))
    anew = rechain(scene, camera, generous, config.seed) if is_far(scene, camera) else None
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
