"""Prior knowledge of a camera, and the bounds of its parameters."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.field import Field
from dashcalib_ros.camera.prior import Prior
from dashcalib_ros.config import IntrinsicsConfig
from dashcalib_ros.reconstruct.scene import Scene, errors_px
from dashcalib_ros.solve.quadratic import Quadratic

# rendered images without noise would make the loss cut off everything
LEAST_LOSS_PX = 0.05


def prior_of(camera: Camera, config: IntrinsicsConfig, noise: float) -> Prior:
    """Return the prior: square pixels and a centred principal point, with their sigmas.

    camera: centred, as found with one focal length. noise: variance of a residual, px^2. The adjustment treats residuals in px as if their sigma
    were 1, so the prior's covariance is divided by the noise.
    """
    width, _ = camera.image_size
    wide = (10 * camera.fx) ** 2
    spread = np.diag([wide, wide, (config.centre_sigma * width) ** 2,
                      (config.centre_sigma * width) ** 2, *np.square(camera.spread)])
    # fx is free; fy equals fx to within the sigma of the aspect ratio
    spread[0, 1] = spread[1, 0] = wide
    spread[1, 1] += (config.aspect_sigma * camera.fx) ** 2
    return Prior(_undistorted(camera), spread / noise)


def bounds_of(camera: Camera, config: IntrinsicsConfig) -> tuple[Floats, Floats]:
    """Return the lowest and the highest values (n,) that are allowed, around a centred camera."""
    width, height = camera.image_size
    reach = np.full(len(camera.names()), config.k_bound)
    reach[:4] = (camera.fx * config.focal_bound, camera.fx * config.focal_bound,
                 width * config.centre_bound, height * config.centre_bound)
    return _undistorted(camera) - reach, _undistorted(camera) + reach


def _undistorted(camera: Camera) -> Floats:
    """Return the parameters without distortion and with a centred principal point."""
    return type(camera).centred(camera.image_size, camera.fx).params


def prior_information(camera: Camera, config: IntrinsicsConfig) -> Floats:
    """Return the prior's information (n, n): the inverse of its covariance at unit noise."""
    return np.asarray(np.linalg.inv(prior_of(camera, config, 1.0).covariance), np.float64)


def extra_sigma_of(camera: Camera) -> Floats:
    """Return the prior sigmas of the coefficients that only the wider model has."""
    return np.array(camera.widened().spread[len(camera.spread):])


def wider_prior(camera: Camera, centred: Camera, config: IntrinsicsConfig,
                sigmas: Sequence[float] = ()) -> Quadratic:
    """Return the prior about the wider model's parameters, and e further ones, at unit noise.

    centred: the camera that the prior is about; camera: where the prior draws from. sigmas: (e,)
    of the further ones.
    """
    information = prior_information(centred, config)
    further = 1 / np.square(np.r_[extra_sigma_of(camera), sigmas])
    draws = information @ (prior_of(centred, config, 1.0).mean - camera.params)
    return Quadratic.prior(information, further, np.r_[draws, np.zeros(len(further))])


def floor_of(camera: Camera, config: IntrinsicsConfig, field: Field | None = None) -> Floats:
    """Return the sigmas (n,) of systematic errors, which no number of turns averages out.

    field: that was taken out of the tracks: what is left of it is the same for all turns.
    """
    floor = np.zeros(len(camera.names()))
    left = 0.0
    if field is not None:
        size_px = float(np.sqrt(np.mean(field.over(camera)**2)))
        left = config.field_floor * min(1.0, size_px / config.whole_field_px)
    floor[:2] = np.hypot(config.focal_floor, left) * camera.fx
    floor[2:4] = config.centre_floor * camera.image_size[0]
    return floor


def loss_px_of(scenes: Sequence[Scene], camera: Camera, config: IntrinsicsConfig) -> float:
    """Return the scale of the Cauchy loss: config.loss times the median residual, px."""
    errors = np.concatenate([errors_px(scene, camera)[scene.structure.used] for scene in scenes])
    return max(config.loss * float(np.median(errors)), LEAST_LOSS_PX)
