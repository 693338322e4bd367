# SPDX-License-Identifier: Apache-2.0
"""The mask of the ego vehicle from the user's segmentation network, as in the paper.

The network segments a few images of the drive; pixels that are vehicle in at least half of them
are masked, so that passing cars are not. Our images are grey: the input has three equal channels.
"""
from __future__ import annotations

import math
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from dashcalib_ros.arrays import Floats32, GreyImage, Mask
from dashcalib_ros.config import MaskConfig
from dashcalib_ros.detect.mask import LARGEST
from dashcalib_ros.errors import ConfigError, InputError, Notice, one_line
from dashcalib_ros.limits import MODEL_BYTES, check_file

# images that vote; the mask is available after the first one
IMAGES = 15
# s of driving between two of them, so that the traffic has changed
PERIOD_S = 2.0
# (width, height) px for models that take any size: nearly 16:9 like dashcams, multiples of 64
SIZE = 1024, 576
# of the picture's width, added to the mask: its outline is blurred, and has strong corners
MARGIN = 0.01
# a fixed number: it decides the order of sums, and so the last digits of results
THREADS = 2
# ImageNet's mean of RGB: nearly all such networks were trained with it
MEAN = np.array([0.485, 0.456, 0.406], np.float32)
# the same, standard deviation
SPREAD = np.array([0.229, 0.224, 0.225], np.float32)


class SegmentationModel:
    """An ONNX model that was run once as a test, and the classes that are masked."""

    def __init__(self, path: str, classes: str) -> None:
        """classes: their numbers, as in '63,64'. Raises ConfigError if the model does not fit."""
        self._path = path
        self._classes = [int(number) for number in classes.split(',')]
        self._session = _session(path)
        inputs = self._session.get_inputs()
        shape = list(inputs[0].shape) if len(inputs) == 1 else []
        fits = [_open(side) or side == wanted for side, wanted in zip(shape, (1, 3), strict=False)]
        if len(shape) != 4 or not all(fits) or inputs[0].type != 'tensor(float)':
            takes = ' and '.join(f'{"x".join(map(str, each.shape))} {each.type}'
                                 for each in inputs)
            raise ConfigError('E-SEGMENTATION-INPUT', f'the segmentation model {path} takes '
                              f'{takes or "no input"}; export it with one input, 1x3xHxW float32')
        self._input = inputs[0].name
        self._size = (SIZE[0] if _open(shape[3]) else shape[3],
                      SIZE[1] if _open(shape[2]) else shape[2])
        # run it now: an error must not come in the middle of the drive
        self.vehicle(np.zeros((self._size[1], self._size[0]), np.uint8))

    def vehicle(self, image: GreyImage) -> Mask:
        """Return where an image (height, width) shows one of the classes.

        The result is (h, w), at the resolution of the model's output.
        """
        small = cv2.resize(image, self._size, interpolation=cv2.INTER_AREA)
        planes = (small.astype(np.float32) / 255 - MEAN[:, None, None]) / SPREAD[:, None, None]
        try:
            # the first output is the result; others are for training
            output = np.asarray(self._session.run(None, {self._input: planes[None]})[0])
        except Exception as error:  # onnxruntime's have no parent in common
            raise ConfigError('E-SEGMENTATION-FAILED', f'the segmentation model {self._path} '
                              f'does not run ({one_line(error)}); export it again') from error
        return self._decided(output)

    def _decided(self, output: npt.NDArray[Any]) -> Mask:
        """Return (h, w), True where logits (1, C, h, w) or labels (1, h, w) have our classes."""
        shape = output.shape
        if output.ndim == 4 and shape[0] == 1 and shape[1] > 1 and output.dtype.kind == 'f':
            if max(self._classes) >= shape[1]:
                raise ConfigError(
                    'E-SEGMENTATION-CLASSES', f'the segmentation model {self._path} has the '
                    f'classes 0 to {shape[1] - 1}, not {",".join(map(str, self._classes))}: set '
                    f'mask.segmentation_classes to those of the ego vehicle')
            # 15 times as fast as argmax, and False for NaN
            return np.asarray(output[0][self._classes].max(axis=0) == output[0].max(axis=0))
        if output.ndim in (3, 4) and set(shape[:-2]) == {1} and output.dtype.kind in 'iu':
            return np.isin(output.reshape(shape[-2:]), self._classes)
        raise ConfigError(
            'E-SEGMENTATION-OUTPUT', f'the segmentation model {self._path} returns '
            f'{"x".join(map(str, shape))} {output.dtype}; export it with 1xCxHxW logits (float) '
            f'or 1xHxW labels (integer) as its first output')


class SegmentationMask:
    """Counts for each pixel in how many of the sampled images it shows the vehicle."""

    def __init__(self, model: SegmentationModel, config: MaskConfig) -> None:
        self._model = model
        self._config = config
        self._votes: Floats32 | None = None
        self._count = 0
        self._sampled_ns = -math.inf

    def push(self, image: GreyImage, stamp_ns: int) -> bool:
        """Take an image (height, width) of the moving car; return whether it was segmented."""
        early = abs(stamp_ns - self._sampled_ns) < 1e9 * PERIOD_S
        if early or self._count == IMAGES:
            return False
        self._sampled_ns = stamp_ns
        vehicle = self._model.vehicle(image).astype(np.float32)
        self._votes = vehicle if self._votes is None else self._votes + vehicle
        self._count += 1
        return True

    def hidden(self, shape: tuple[int, int]) -> Mask | None:
        """Return (height, width) of the full image: where the vehicle is; None if unknown."""
        found = self._found()
        if found is None or found.mean() > LARGEST or not found.any():
            return None
        assert self._votes is not None
        # interpolate between the output's pixels, which are coarse
        share = cv2.resize(self._votes / np.float32(self._count), shape[::-1],
                           interpolation=cv2.INTER_LINEAR)
        side = 2 * math.ceil(MARGIN * shape[1]) + 1
        widened = cv2.dilate((share >= 0.5).astype(np.uint8), np.ones((side, side), np.uint8))
        return np.asarray(widened > 0)

    def warning(self) -> Notice | None:
        """Return a warning for the user, one line; None where the result looks right."""
        found = self._found()
        remedy = 'check mask.segmentation_classes'
        if found is None:
            return None
        if not found.any():
            return Notice('E-SEGMENTATION-EMPTY', f'the segmentation model finds no part of the '
                          f'ego vehicle; if the images show one, {remedy}')
        if found.mean() > LARGEST:
            return Notice('E-SEGMENTATION-TOO-LARGE', f'the mask of the segmentation model is not '
                          f'used: it covers {100 * found.mean():.0f} % of the image, and the '
                          f'limit is {100 * LARGEST:.0f} %; {remedy}')
        return None

    def _found(self) -> Mask | None:
        """Return (h, w) at the output's resolution: where the vehicle is; None without images."""
        return None if self._votes is None else self._votes >= 0.5 * self._count


def open_segmentation(config: MaskConfig) -> SegmentationModel | None:
    """Return the model of the settings, None if they have none; raises ConfigError."""
    if not config.segmentation:
        return None
    return _opened(config.segmentation, config.segmentation_classes)


@lru_cache(maxsize=1)
def _opened(path: str, classes: str) -> SegmentationModel:
    # cached: after a reset, the node must not read it again while images wait
    return SegmentationModel(path, classes)


def _session(path: str) -> Any:
    file = Path(path)
    with suppress(RuntimeError):  # ~user of an unknown user: the path stays as it is
        file = file.expanduser()
    try:
        check_file(file, f'the segmentation model {path}', MODEL_BYTES)
    except InputError as error:
        raise ConfigError(error.code, str(error)) from error
    except OSError as error:
        raise ConfigError('E-SEGMENTATION-PATH', f'the segmentation model {path} cannot be opened '
                          f'({error.strerror}); check the path') from error
    try:
        import onnxruntime
    except ImportError as error:
        raise ConfigError('E-EXTRA-NOT-INSTALLED', 'a segmentation model needs onnxruntime, which '
                          'is not installed: pip install onnxruntime') from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = THREADS
    # otherwise its threads keep a core busy between two images
    options.add_session_config_entry('session.intra_op.allow_spinning', '0')
    options.log_severity_level = 4  # errors are raised, not logged
    onnxruntime.set_default_logger_severity(4)
    try:
        return onnxruntime.InferenceSession(str(file), options, ['CPUExecutionProvider'])
    except Exception as error:  # onnxruntime's have no parent in common
        raise ConfigError('E-SEGMENTATION-UNREADABLE', f'onnxruntime cannot load {path} '
                          f'({one_line(error)}); export the model again, or upgrade onnxruntime'
                          ) from error


def _open(side: Any) -> bool:
    return not isinstance(side, int) or side <= 0
