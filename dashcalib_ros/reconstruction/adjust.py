"""Bundle adjustment of scenes that share one camera: the only module that talks to COLMAP.

COLMAP counts pixels from (0.5, 0.5); everything that enters or leaves here counts from (0, 0).
"""
from __future__ import annotations

import zlib  # noqa: F401  before pycolmap: its wheel exports zlib symbols of its own
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pyceres  # its import makes the adjuster's problem a pyceres.Problem
import pycolmap

from dashcalib_ros.reconstruction.camera import Camera
from dashcalib_ros.reconstruction.scene import Scene

Array = npt.NDArray[np.float64]

HALF_PIXEL = 0.5
# fx fy cx cy k1 k2 p1 p2 of COLMAP's OPENCV model: the last two stay 0
OPENCV_HELD = [6, 7]
OPENCV_SIZE = 8
# k1 and k2 beyond this are no lens but a scene that runs away
MAX_K = 1.0


@dataclass(frozen=True)
class Prior:
    """What is believed of the six parameters before any image: mean (6,), covariance (6, 6)."""

    mean: Array
    covariance: Array


@dataclass(frozen=True)
class Solver:
    """How hard to try. loss_px: scale of the Cauchy loss, about twice the noise of a track."""

    loss_px: float = 1.0
    iterations: int = 30
    tolerance: float = 1e-5
    threads: int = 1


def adjust_step1(scenes: Sequence[Scene], camera: Camera, solver: Solver,
                 focal_range: tuple[float, float] | None) -> tuple[list[Scene], Camera]:
    """Adjust with one focal length, k1 and k2, the centre fixed (paper, 3.2, step 1).

    focal_range: px, lowest and highest focal length; None holds it where it is: one point of its
    profile.
    """
    params = [camera.fx, camera.cx + HALF_PIXEL, camera.cy + HALF_PIXEL, camera.k1, camera.k2]
    colmap = _camera('RADIAL', camera, params)
    reconstruction = _reconstruction(scenes, colmap)
    adjuster = _adjuster(reconstruction, solver, refine_focal=focal_range is not None,
                         refine_centre=False)
    values = reconstruction.cameras[1].params
    if not adjuster.problem.has_parameter_block(values):
        return list(scenes), camera  # nothing is seen: there is nothing to adjust
    if focal_range is not None:
        _bound(adjuster.problem, values, 0, *focal_range)
    for index in (3, 4):
        _bound(adjuster.problem, values, index, -MAX_K, MAX_K)
    adjuster.solve()
    focal, _, _, k1, k2 = reconstruction.cameras[1].params
    return (_updated(scenes, reconstruction),
            replace(camera, fx=float(focal), fy=float(focal), k1=float(k1), k2=float(k2)))


def adjust_step2(scenes: Sequence[Scene], camera: Camera, solver: Solver, prior: Prior,
                 bounds: tuple[Array, Array]) -> tuple[list[Scene], Camera]:
    """Adjust all six parameters within bounds and under a prior (paper, 3.2, step 2).

    bounds: lowest and highest fx, fy, cx, cy, k1, k2, (6,) each.
    """
    shift = np.array([0, 0, HALF_PIXEL, HALF_PIXEL, 0, 0])
    colmap = _camera('OPENCV', camera, [*(camera.params + shift), 0.0, 0.0])
    reconstruction = _reconstruction(scenes, colmap)
    adjuster = _adjuster(reconstruction, solver, refine_focal=True, refine_centre=True)
    values = reconstruction.cameras[1].params
    problem = adjuster.problem
    if not problem.has_parameter_block(values):
        return list(scenes), camera
    problem.set_manifold(values, pyceres.SubsetManifold(OPENCV_SIZE, OPENCV_HELD))
    for index, (low, high) in enumerate(zip(bounds[0] + shift, bounds[1] + shift, strict=True)):
        _bound(problem, values, index, low, high)
    mean = np.zeros(OPENCV_SIZE)
    mean[:6] = prior.mean + shift
    covariance = np.eye(OPENCV_SIZE)
    covariance[:6, :6] = prior.covariance
    problem.add_residual_block(
        pyceres.factors.NormalPrior(mean, covariance), pyceres.TrivialLoss(), [values])
    adjuster.solve()
    params = np.array(reconstruction.cameras[1].params)[:6] - shift
    return _updated(scenes, reconstruction), camera.with_params(params)


def _camera(model: str, camera: Camera, params: Sequence[float]) -> pycolmap.Camera:
    width, height = camera.image_size
    return pycolmap.Camera(camera_id=1, model=model, width=width, height=height, params=params)


def _reconstruction(scenes: Sequence[Scene], camera: pycolmap.Camera) -> pycolmap.Reconstruction:
    """Return the scenes, side by side, as one COLMAP reconstruction with one camera."""
    reconstruction = pycolmap.Reconstruction()
    reconstruction.add_camera_with_trivial_rig(camera)
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


def _adjuster(reconstruction: pycolmap.Reconstruction, solver: Solver, refine_focal: bool,
              refine_centre: bool) -> pycolmap.CeresBundleAdjuster:
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = refine_focal
    options.refine_principal_point = refine_centre
    options.refine_extra_params = True
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = solver.loss_px
    options.ceres.solver_options.max_num_iterations = solver.iterations
    options.ceres.solver_options.function_tolerance = solver.tolerance
    options.ceres.solver_options.num_threads = solver.threads
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in reconstruction.reg_image_ids():
        config.add_image(image_id)
    return pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction)


def _bound(problem: pyceres.Problem, values: Array, index: int, low: float, high: float) -> None:
    # a start outside its bounds is an error in Ceres
    values[index] = min(max(values[index], low), high)
    problem.set_parameter_lower_bound(values, index, low)
    problem.set_parameter_upper_bound(values, index, high)


def _updated(scenes: Sequence[Scene], reconstruction: pycolmap.Reconstruction) -> list[Scene]:
    """Return the scenes with the poses and points that COLMAP has moved."""
    updated = []
    point_ids = iter(sorted(reconstruction.point3D_ids()))
    for scene, first_id in zip(scenes, _first_ids(scenes), strict=True):
        structure = scene.structure
        rotations, translations = structure.rotations.copy(), structure.translations.copy()
        for k in np.flatnonzero(structure.registered):
            pose = reconstruction.image(int(first_id + k)).cam_from_world()
            rotations[k], translations[k] = pose.rotation.matrix(), pose.translation
        points = structure.points.copy()
        for t in np.flatnonzero(structure.used.any(axis=0)):
            points[t] = reconstruction.point3D(next(point_ids)).xyz
        updated.append(replace(scene, structure=replace(
            structure, rotations=rotations, translations=translations, points=points)))
    return updated
