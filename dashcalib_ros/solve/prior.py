"""Prior knowledge of a camera, and the bounds of its parameters."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.camera import Prior
from dashcalib_ros.config import IntrinsicsConfig
from dashcalib_ros.reconstruct.scene import Scene, errors_px
from dashcalib_ros.solve.normal import Further
from dashcalib_ros.solve.quadratic import Quadratic

# rendered images without noise would make the loss cut off everything
LEAST_LOSS_PX = 0.05
# of the width: how far lenses sit off the middle of their sensors
CENTRE_SIGMA = 0.02
# how far parameters may go from the centred camera: fx and fy of its focal length; the centre of
# the picture's width and height, as a third may be cut off on one side; no lens has larger k1, k2
FOCAL_BOUND, CENTRE_BOUND, DISTORTION_BOUND = 0.15, (0.2, 0.3), 1.0
# systematic errors of the tracking: of fx, for fx and fy; of the width, for cx and cy
FOCAL_FLOOR, CENTRE_FLOOR = 0.0005, 0.0003
# of fx for each px^2 of noise: a video with few bits moves its contents with their blocks, in all
# turns alike. H.264 with 0.03 bits per pixel was up to 1.2 % off, at 0.056 px^2
NOISE_FLOOR = 0.1


def prior_of(camera: Camera, config: IntrinsicsConfig, noise: float) -> Prior:
    """Return the prior: square pixels and a centred principal point.

    camera: centred, as found with one focal length. noise: variance of a residual, px^2. The
    adjustment treats residuals in px as if their sigma were 1, so the prior's covariance is
    divided by the noise.
    """
    width, _ = camera.image_size
    wide = (10 * camera.fx) ** 2
    spread = np.diag([wide, wide, (CENTRE_SIGMA * width) ** 2,
                      (CENTRE_SIGMA * width) ** 2, *np.square(camera.spread)])
    # fx is free; fy equals fx to within the sigma of the aspect ratio
    spread[0, 1] = spread[1, 0] = wide
    spread[1, 1] += (config.aspect_sigma * camera.fx) ** 2
    return Prior(_undistorted(camera), spread / noise)


def bounds_of(camera: Camera) -> tuple[Floats, Floats]:
    """Return the lowest and the highest values (n,) that are allowed, around a centred camera."""
    width, height = camera.image_size
    reach = np.full(len(camera.names()), DISTORTION_BOUND)
    reach[:4] = (camera.fx * FOCAL_BOUND, camera.fx * FOCAL_BOUND,
                 width * CENTRE_BOUND[0], height * CENTRE_BOUND[1])
    return _undistorted(camera) - reach, _undistorted(camera) + reach


def _undistorted(camera: Camera) -> Floats:
    """Return the parameters without distortion and with a centred principal point."""
    return type(camera).centred(camera.image_size, camera.fx).params


def prior_information(camera: Camera, config: IntrinsicsConfig) -> Floats:
    """Return the prior's information (n, n): the inverse of its covariance at unit noise."""
    return np.asarray(np.linalg.inv(prior_of(camera, config, 1.0).covariance), np.float64)


def centre_pull(camera: Camera, covariance: Floats) -> Floats:
    """Return (n,) how far the prior of the centre has drawn the camera with this covariance.

    The prior is right for lenses; a picture of which a side was cut off has its centre elsewhere.
    """
    width, height = camera.image_size
    off = np.array([(width - 1) / 2, (height - 1) / 2]) - [camera.cx, camera.cy]
    return np.asarray(covariance[:, 2:4] @ off / (CENTRE_SIGMA * width)**2)


def extra_sigma_of(camera: Camera) -> Floats:
    """Return the prior sigmas of the coefficients that only the wider model has."""
    return np.array(camera.widened().spread[len(camera.spread):])


def wider_prior(camera: Camera, centred: Camera, config: IntrinsicsConfig,
                further: Sequence[Further] = ()) -> Quadratic:
    """Return the prior about the wider model's parameters, and further ones, at unit noise.

    centred: the camera that the prior is about; camera: where the prior draws from.
    """
    information = prior_information(centred, config)
    sigmas = np.concatenate([extra_sigma_of(camera), *(each.sigmas for each in further)])
    draws = information @ (prior_of(centred, config, 1.0).mean - camera.params)
    return Quadratic.prior(information, 1 / np.square(sigmas),
                           np.r_[draws, np.zeros(len(sigmas))])


def floor_of(camera: Camera, noise: float) -> Floats:
    """Return the sigmas (n,) of systematic errors, which no number of turns averages out.

    noise: variance of a residual, px^2.
    """
    floor = np.zeros(len(camera.names()))
    floor[:2] = np.hypot(FOCAL_FLOOR, NOISE_FLOOR * noise) * camera.fx
    floor[2:4] = CENTRE_FLOOR * camera.image_size[0]
    return floor


def loss_px_of(scenes: Sequence[Scene], camera: Camera, config: IntrinsicsConfig) -> float:
    """Return the scale of the Cauchy loss: config.loss times the median residual, px."""
    errors = np.concatenate([errors_px(scene, camera)[scene.structure.used] for scene in scenes])
    return max(config.loss * float(np.median(errors)), LEAST_LOSS_PX)
