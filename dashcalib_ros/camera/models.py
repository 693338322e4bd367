# SPDX-License-Identifier: Apache-2.0
"""The table of camera models. A new model is a class in the file of its family and a row here."""
from __future__ import annotations

import re

import numpy as np
import numpy.typing as npt

from dashcalib_ros.camera.camera import Camera
from dashcalib_ros.camera.fisheye import Fisheye
from dashcalib_ros.camera.pinhole import Brown, Radial, Rational
from dashcalib_ros.errors import ConfigError, InputError, shortened

# as a setting: the turns choose
AUTO = 'auto'
MODELS: dict[str, type[Camera]] = {
    model.model: model for model in (Radial, Brown, Fisheye, Rational)}


def calibrated_models() -> list[type[Camera]]:
    """Return the models that turns can determine."""
    return [model for model in MODELS.values() if not model.given_only]


def model_named(name: str) -> type[Camera]:
    """Return the model of this name that is to be calibrated. Raises ConfigError."""
    if name in MODELS and not MODELS[name].given_only:
        return MODELS[name]
    known = ', '.join([AUTO, *(model.model for model in calibrated_models())])
    if name in MODELS:
        raise ConfigError('E-MODEL-NOT-CALIBRATED', f'turns cannot determine the coefficients of '
                          f'the camera model {name}; use one of {known}')
    raise ConfigError('E-MODEL-UNKNOWN',
                      f'unknown camera model {shortened(repr(name))}; use one of {known}')


def searched(name: str) -> tuple[type[Camera], ...]:
    """Return the models that the search for a start tries; 'auto': one for each family.

    Raises ConfigError for a name that is not known.
    """
    if name != AUTO:
        return (model_named(name),)
    families: dict[str, type[Camera]] = {}
    for model in calibrated_models():
        families.setdefault(model.family, model)
    return tuple(families.values())


def larger_models(camera: Camera) -> list[type[Camera]]:
    """Return the models that turns can determine with more parameters than the camera's."""
    return [model for model in calibrated_models() if len(model.names()) > len(camera.names())]


def camera_of(model: str, image_size: tuple[int, int], params: npt.ArrayLike) -> Camera:
    """Return the camera of a model's name; raises InputError for a model that is not known."""
    if model not in MODELS:
        raise InputError('E-MODEL-UNKNOWN',
                         f'unknown camera model {model!r}; use one of {", ".join(MODELS)}')
    return MODELS[model].of(image_size, params)


def camera_from_ros(image_size: tuple[int, int], distortion_model: str, k: npt.ArrayLike,
                    d: npt.ArrayLike) -> Camera:
    """Return the simplest camera that CameraInfo's K (9,) and D (n,) describe.

    distortion_model: also by another of its names; where there is no distortion, it may be none.
    Raises InputError where no model here has such a distortion.
    """
    matrix = np.asarray(k, np.float64)
    fx, _, cx, _, fy, cy = matrix[:6]
    if not np.array_equal(matrix, [fx, 0, cx, 0, fy, cy, 0, 0, 1]):
        raise InputError('E-CAMERA-SKEW',
                         'the camera matrix is not [fx 0 cx; 0 fy cy; 0 0 1], and '
                         'no supported model has skew: calibrate without it')
    wanted = np.trim_zeros(np.asarray(d, np.float64), 'b')
    name = re.sub('[ -]', '_', distortion_model.strip().lower())
    if name in NO_DISTORTION and not len(wanted):
        name = Radial.ros_model
    # fewer parameters come first in the table
    for model in MODELS.values():
        if name not in (model.ros_model, *ALIASES.get(model.ros_model, ())):
            continue
        size = len(model.names()) - 4
        camera = model.of(image_size, [fx, fy, cx, cy, *wanted[:size],
                                       *np.zeros(max(0, size - len(wanted)))])
        if np.array_equal(np.trim_zeros(np.array(camera.ros_distortion()), 'b'), wanted):
            return camera
    raise InputError('E-MODEL-DISTORTION', f'the distortion model '
                     f'{shortened(repr(distortion_model))} with {len(wanted)} coefficients is not '
                     f'supported; calibrate the camera with one of {", ".join(ROS_MODELS)}')


def misread(camera: Camera) -> Camera | None:
    """Return the camera of the other family of lenses that CameraInfo's K and D would be.

    None where D has more numbers than that.
    """
    d = camera.ros_distortion()
    other = next(model for model in MODELS.values() if model.family != camera.family)
    return None if any(d[4:]) else camera_from_ros(
        camera.image_size, other.ros_model, camera.matrix.ravel(), d[:4])


ROS_MODELS = tuple(dict.fromkeys(model.ros_model for model in MODELS.values()))
# other names that ROS, Foxglove and Kalibr have for a model, or for one that contains it
ALIASES = {'plumb_bob': ('rational_polynomial', 'radtan', 'radial_tangential'),
           'equidistant': ('fisheye', 'equi', 'kannala_brandt')}
# names of what has no distortion: simulators and ideal lenses
NO_DISTORTION = ('', 'none', 'null', 'pinhole', 'perspective', 'ideal')
