"""Bundle adjustment of scenes that share one camera, by COLMAP and Ceres.

COLMAP counts pixels from (0.5, 0.5); everything that enters or leaves here counts from (0, 0).
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.camera import HALF_PIXEL, ColmapModel
from dashcalib_ros.config import SceneConfig
from dashcalib_ros.reconstruct.colmap import pyceres, pycolmap
from dashcalib_ros.reconstruct.scene import Scene, projected_px, retriangulated

# no lens has a coefficient beyond this: the scene has diverged
MAX_DISTORTION = 1.0
# relative change of the cost that ends an adjustment which another one follows, or whose cost is
# only compared
ROUGH = 1e-3
# cosine (88 degrees): COLMAP's fisheye models project nothing from beside or behind the camera
IN_FRONT = 0.035

# What of the camera is free beside poses and points. COLMAP's models with one focal length have
# the first coefficients of distortion only: 'first distortion' frees those, 'one focal length' the
# focal length with them. The others stay as they are, which is right only where they are 0
Free = Literal['nothing', 'first distortion', 'distortion', 'one focal length']


@dataclass(frozen=True)
class Solver:
    """Options of Ceres. loss_px: scale of the Cauchy loss, about twice the noise of a track."""

    loss_px: float = 1.0
    iterations: int = 30
    tolerance: float = 1e-5


def adjust(scenes: Sequence[Scene], camera: Camera, solver: Solver, free: Free,
           focal_range: tuple[float, float] | None = None) -> tuple[list[Scene], Camera]:
    """Adjust poses, points and what is free of the camera's n parameters; the others are fixed.

    focal_range: px, lowest and highest, for one focal length. Scenes without observations stay as
    they are.
    """
    # smaller, and enough where it has all coefficients
    single = free in ('first distortion', 'one focal length') or (
        free == 'distortion' and len(camera.colmap_one_focal.places) == len(camera.names()))
    model = camera.colmap_one_focal if single else camera.colmap
    adjustable = _in_front(scenes)
    reconstruction = _reconstruction(adjustable, camera, model)
    adjuster = _adjuster(reconstruction, solver, refine_focal=free == 'one focal length')
    problem, values = adjuster.problem, reconstruction.cameras[1].params
    if not problem.has_parameter_block(values):
        return list(scenes), camera
    if free == 'nothing':
        problem.set_parameter_block_constant(values)
    else:
        if not single:
            problem.set_manifold(values, pyceres.SubsetManifold(
                model.size, sorted({*model.fixed, *model.places[:4]})))
        if focal_range is not None:
            _bound(problem, values, model.places[0], *focal_range)
        for place in model.places[4:]:
            _bound(problem, values, place, -MAX_DISTORTION, MAX_DISTORTION)
    adjuster.solve()
    moved = _updated(scenes, adjustable, reconstruction)
    if free == 'nothing':
        return _projected(moved, camera), camera
    found = camera.params
    found[:len(model.places)] = model.params(reconstruction.cameras[1].params)
    # the conversion from COLMAP's pixels rounds: keep what was fixed exact
    first = 2 if free == 'one focal length' else 0
    found[first:4] = camera.params[first:4]
    camera = camera.with_params(found)
    return _projected(moved, camera), camera


def refined(scene: Scene, config: SceneConfig, reach: tuple[float, float] | None,
            tolerance: float = ROUGH) -> Scene:
    """Return the scene after an adjustment and triangulation."""
    solver = Solver(config.loss_px, config.iterations, tolerance)
    free: Free = 'first distortion' if reach is None else 'one focal length'
    [scene], camera = adjust([scene], scene.camera, solver, free, reach)
    return retriangulated(scene, camera, config.error_px, config.min_angle_deg)


def _in_front(scenes: Sequence[Scene]) -> list[Scene]:
    """Return the scenes with those observations only that COLMAP can adjust.

    Points that are left with fewer than two do not move; they are triangulated anew afterwards.
    """
    found = []
    for scene in scenes:
        structure = scene.structure
        local = (structure.points @ structure.rotations.transpose(0, 2, 1)
                 + structure.translations[:, None])
        ahead = local[:, :, 2] > IN_FRONT * np.linalg.norm(local, axis=2)
        used = structure.used & ahead
        used &= used.sum(axis=0) >= 2
        found.append(replace(scene, structure=replace(structure, used=used)))
    return found


def _projected(scenes: Sequence[Scene], camera: Camera) -> list[Scene]:
    """Return the scenes without the observations of points that are behind the camera now.

    They have no residual: one is enough to make noise and sigma NaN.
    """
    found = []
    for scene in scenes:
        ahead = np.isfinite(projected_px(scene, camera)).all(axis=1)
        if not ahead.all():
            used = scene.structure.used.copy()
            used[used] = ahead
            scene = replace(scene, structure=replace(scene.structure, used=used))
        found.append(scene)
    return found


def _reconstruction(scenes: Sequence[Scene], camera: Camera, model: ColmapModel
                    ) -> pycolmap.Reconstruction:
    """Return the scenes, side by side, as one COLMAP reconstruction with one camera."""
    width, height = camera.image_size
    reconstruction = pycolmap.Reconstruction()
    reconstruction.add_camera_with_trivial_rig(pycolmap.Camera(
        camera_id=1, model=model.name, width=width, height=height,
        params=model.values(camera.params[:len(model.places)])))
    for scene, first_id in zip(scenes, _first_ids(scenes), strict=True):
        structure = scene.structure
        rank = np.cumsum(structure.used, axis=1) - 1
        for k in np.flatnonzero(structure.registered):
            image = pycolmap.Image(
                name=str(first_id + k), camera_id=1, image_id=int(first_id + k),
                keypoints=scene.tracks.xy[k, structure.used[k]] + HALF_PIXEL)
            pose = pycolmap.Rigid3d(
                pycolmap.Rotation3d(structure.rotations[k]), structure.translations[k])
            reconstruction.add_image_with_trivial_frame(image, pose)
        tracks, keyframes = np.nonzero(structure.used.T)
        names, places = (first_id + keyframes).tolist(), rank[keyframes, tracks].tolist()
        points, starts = np.unique(tracks, return_index=True)
        ends = np.append(starts, len(tracks))[1:].tolist()
        for t, start, end in zip(points.tolist(), starts.tolist(), ends, strict=True):
            track = pycolmap.Track()
            for name, place in zip(names[start:end], places[start:end], strict=True):
                track.add_element(name, place)
            reconstruction.add_point3D(structure.points[t], track)
    return reconstruction


def _first_ids(scenes: Sequence[Scene]) -> list[int]:
    counts = [len(scene.tracks.frames) for scene in scenes]
    return [1 + sum(counts[:n]) for n in range(len(counts))]


def _adjuster(reconstruction: pycolmap.Reconstruction, solver: Solver, refine_focal: bool
              ) -> pycolmap.CeresBundleAdjuster:
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = refine_focal
    options.refine_principal_point = False
    options.refine_extra_params = True
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = solver.loss_px
    options.ceres.solver_options.max_num_iterations = solver.iterations
    options.ceres.solver_options.function_tolerance = solver.tolerance
    # with bounds, Ceres evaluates every step once more for a line search. Without, a step that
    # leaves them ends on them, and counts only if the cost falls: 0.8 of the time
    options.ceres.solver_options.max_num_line_search_step_size_iterations = 0
    options.ceres.solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in reconstruction.reg_image_ids():
        config.add_image(image_id)
    return pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction)


def _bound(problem: pyceres.Problem, values: Floats, index: int, low: float, high: float) -> None:
    # Ceres refuses a start outside its bounds
    values[index] = min(max(values[index], low), high)
    problem.set_parameter_lower_bound(values, index, low)
    problem.set_parameter_upper_bound(values, index, high)


def _updated(scenes: Sequence[Scene], adjusted: Sequence[Scene],
             reconstruction: pycolmap.Reconstruction) -> list[Scene]:
    """Return the scenes with the poses and points that COLMAP has moved.

    adjusted: the same scenes with those observations only that were adjusted.
    """
    updated = []
    point_ids = iter(sorted(reconstruction.point3D_ids()))
    for scene, part, first_id in zip(scenes, adjusted, _first_ids(scenes), strict=True):
        structure = scene.structure
        rotations, translations = structure.rotations.copy(), structure.translations.copy()
        for k in np.flatnonzero(structure.registered):
            pose = reconstruction.image(int(first_id + k)).cam_from_world()
            rotations[k], translations[k] = pose.rotation.matrix(), pose.translation
        points = structure.points.copy()
        for t in np.flatnonzero(part.structure.used.any(axis=0)):
            points[t] = reconstruction.point3D(next(point_ids)).xyz
        updated.append(replace(scene, structure=replace(
            structure, rotations=rotations, translations=translations, points=points)))
    return updated
