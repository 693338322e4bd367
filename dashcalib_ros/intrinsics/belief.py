"""What is believed of a camera before its turns are asked, and how far each number may move."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from dashcalib_ros.config import IntrinsicsConfig
from dashcalib_ros.reconstruction.adjust import Prior
from dashcalib_ros.reconstruction.camera import Camera
from dashcalib_ros.reconstruction.scene import Scene, errors_px

Array = npt.NDArray[np.float64]
# rendered images without noise would make the loss cut off everything
LEAST_LOSS_PX = 0.05


def prior_of(camera: Camera, config: IntrinsicsConfig, noise: float) -> Prior:
    """Return square pixels and a centred principal point, as far as either is believed.

    noise: variance of a residual, px^2. The adjustment takes residuals in px as if their sigma
    were 1: the prior must be weakened by as much as they are more exact.
    """
    width, height = camera.image_size
    wide = (10 * camera.fx) ** 2
    spread = np.diag([wide, wide, (config.centre_sigma * width) ** 2,
                      (config.centre_sigma * width) ** 2, 1.0, 1.0])
    # fx may be anything; fy is fx to within the aspect's sigma
    spread[0, 1] = spread[1, 0] = wide
    spread[1, 1] += (config.aspect_sigma * camera.fx) ** 2
    mean = np.array([camera.fx, camera.fx, (width - 1) / 2, (height - 1) / 2, 0.0, 0.0])
    return Prior(mean, spread / noise)


def bounds_of(camera: Camera, config: IntrinsicsConfig) -> tuple[Array, Array]:
    """Return the lowest and the highest values of step 2 (the paper: 'within bounds')."""
    width, height = camera.image_size
    middle = np.array([camera.fx, camera.fx, (width - 1) / 2, (height - 1) / 2, 0.0, 0.0])
    reach = np.array([camera.fx * config.focal_bound, camera.fx * config.focal_bound,
                      width * config.centre_bound, height * config.centre_bound,
                      config.k_bound, config.k_bound])
    return middle - reach, middle + reach


def belief_of(camera: Camera, config: IntrinsicsConfig) -> Array:
    """Return the prior's information (6, 6) at unit noise."""
    return np.asarray(np.linalg.inv(prior_of(camera, config, 1.0).covariance), np.float64)


def loss_px_of(scenes: Sequence[Scene], camera: Camera, config: IntrinsicsConfig) -> float:
    """Return the scale of the Cauchy loss: as wide as this drive's residuals are."""
    errors = np.concatenate([errors_px(scene, camera)[scene.structure.used] for scene in scenes])
    return max(config.loss * float(np.median(errors)), LEAST_LOSS_PX)
