# SPDX-License-Identifier: Apache-2.0
"""Prior knowledge of a camera, and the bounds of its parameters."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dashcalib_ros.arrays import Floats, Ints
from dashcalib_ros.camera import Camera
from dashcalib_ros.config import IntrinsicsConfig
from dashcalib_ros.reconstruct.scene import Scene, errors_px
from dashcalib_ros.solve.imaging import Imaging
from dashcalib_ros.solve.linear import IMAGE, ImagePrior, used_keyframes
from dashcalib_ros.solve.quadratic import Quadratic

# of fy / fx, where pixels are not square, and the nats of evidence that this takes
NOT_SQUARE, NOT_SQUARE_NATS = 0.05, 3.0
# s: most dashcams have a rolling shutter, of 10 to 30 ms
READOUT_SIGMA_S = 0.02
# rendered images without noise would make the loss cut off everything
LEAST_LOSS_PX = 0.05
# of the width: how far lenses sit off the middle of their sensors
CENTRE_SIGMA = 0.02
# how far parameters may go from the centred camera: fx and fy of its focal length; the centre of
# the picture's width and height, as a third may be cut off on one side; no lens has larger k1, k2
FOCAL_BOUND, CENTRE_BOUND, DISTORTION_BOUND = 0.15, (0.2, 0.3), 1.0
# prior sigma of a stabiliser's crop, of the width, and how long it holds it, s
CROP_SIGMA, CROP_TIME_S = 0.03, 1.0
# the same of a shift that is smaller, in units of that time
WANDER_TIMES = 1.5
# prior sigmas of the zoom: of one image, of a stretch, of a turn
ZOOM_IMAGE, ZOOM_STRETCH, ZOOM_TURN = 0.01, 0.02, 0.03


@dataclass(frozen=True)
class Prior:
    """A normal distribution of the n parameters: mean (n,), covariance (n, n)."""

    mean: Floats
    covariance: Floats


def prior_of(camera: Camera, aspect_sigma: float) -> Prior:
    """Return the prior: square pixels and a centred principal point.

    camera: centred, as found with one focal length. aspect_sigma: of fy / fx.
    """
    width, _ = camera.image_size
    wide = (10 * camera.fx) ** 2
    spread = np.diag([wide, wide, (CENTRE_SIGMA * width) ** 2,
                      (CENTRE_SIGMA * width) ** 2, *np.square(camera.spread)])
    # fx is free; fy equals fx to within the sigma of the aspect ratio
    spread[0, 1] = spread[1, 0] = wide
    spread[1, 1] += (aspect_sigma * camera.fx) ** 2
    return Prior(_undistorted(camera), spread)


def bounds_of(camera: Camera, focal_reach: float = FOCAL_BOUND) -> tuple[Floats, Floats]:
    """Return the lowest and the highest values (n,) that are allowed, around a centred camera."""
    width, height = camera.image_size
    reach = np.full(len(camera.names()), DISTORTION_BOUND)
    reach[:4] = (camera.fx * focal_reach, camera.fx * focal_reach,
                 width * CENTRE_BOUND[0], height * CENTRE_BOUND[1])
    return _undistorted(camera) - reach, _undistorted(camera) + reach


def crop_prior(scene: Scene, variance: float, images: Floats, size: float = CROP_SIGMA
               ) -> ImagePrior:
    """Return the prior of the shifts of a turn's images.

    variance: of a residual, px^2. images: (k, 3) the present values. size: their sigma, of the
    width: CROP_SIGMA as a stabiliser makes them; smaller ones wander slowly and smoothly.
    """
    keyframes, apart = used_keyframes(scene), _apart(scene)
    smooth = np.exp(-apart if size >= CROP_SIGMA else -0.5 * (apart / WANDER_TIMES)**2)
    spread = (size * scene.tracks.image_size[0])**2 * (
        smooth + 1e-6 * np.eye(len(keyframes)))
    inner = np.asarray(np.linalg.inv(spread) * variance)
    return ImagePrior(image_places(keyframes, 0, 1), np.asarray(np.kron(np.eye(2), inner)),
                      images[keyframes, :2].T.ravel())


def zoom_prior(scene: Scene, variance: float) -> ImagePrior:
    """Return the prior of the zooms of a turn's images, which are 0 now."""
    keyframes = used_keyframes(scene)
    spread = (ZOOM_STRETCH**2 * np.exp(-_apart(scene))
              + ZOOM_IMAGE**2 * np.eye(len(keyframes)) + ZOOM_TURN**2)
    return ImagePrior(image_places(keyframes, 2), np.asarray(np.linalg.inv(spread) * variance),
                      np.zeros(len(keyframes)))


def _apart(scene: Scene) -> Floats:
    """Return (k, k) how far the used keyframes are apart, in units of a stabiliser's time."""
    seconds = scene.tracks.stamps_ns[used_keyframes(scene)] / 1e9
    return np.asarray(np.abs(seconds[:, None] - seconds) / CROP_TIME_S)


def image_places(keyframes: Ints, *components: int) -> Ints:
    """Return the places of these components among the images' parameters."""
    return np.concatenate([IMAGE * np.arange(len(keyframes)) + component
                           for component in components])


def _undistorted(camera: Camera) -> Floats:
    """Return the parameters without distortion and with a centred principal point."""
    return type(camera).centred(camera.image_size, camera.fx).params


def prior_of_all(imaging: Imaging, centred: Camera, aspect_sigma: float, field_sigma: float
                 ) -> Quadratic:
    """Return the priors of the lens, the readout and the field, from their present values.

    centred: the camera that the lens's prior is about. aspect_sigma: of fy / fx. field_sigma: of
    each of the field's directions, px; inf: it has none.
    """
    prior = prior_of(centred, aspect_sigma)
    information = np.asarray(np.linalg.inv(prior.covariance), np.float64)
    off = imaging.camera.params - prior.mean
    rest = np.r_[READOUT_SIGMA_S**-2, np.full(len(imaging.directions), field_sigma**-2)]
    return Quadratic.prior(information, rest, -np.r_[
        information @ off, rest * np.r_[imaging.readout_s, imaging.directions]])


def loss_px_of(scenes: Sequence[Scene], camera: Camera, config: IntrinsicsConfig) -> float:
    """Return the scale of the Cauchy loss: config.loss times the median residual, px."""
    errors = np.concatenate([errors_px(scene, camera)[scene.structure.used] for scene in scenes])
    return max(config.loss * float(np.median(errors)), LEAST_LOSS_PX)
