"""The ego vehicle as the user's own segmentation network sees it: the paper's way.

The network is asked about a few images of the drive; what it calls vehicle in half of them or more
is left out. Cars that pass are outvoted. Our images are grey: they go in as three equal channels.
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

from dashcalib_ros.config import MaskConfig
from dashcalib_ros.errors import ConfigError, one_line
from dashcalib_ros.motion.mask import LARGEST
from dashcalib_ros.motion.points import Grey, Mask

# images that vote; a mask is there from the first on
VOTES = 15
# s of driving between them: the traffic has changed
PERIOD = 2.0
# (width, height) px for models that take any: nearly all dashcams are 16:9; divides by 64
SIZE = 1024, 576
# of the picture's width; networks blur the outline, and just there are the strongest corners
MARGIN = 0.01
# as many as reconstruct turns; a fixed number, so that sums have one order everywhere
THREADS = 2
# ImageNet's, of RGB: what nearly all such networks were trained with
MEAN = np.array([0.485, 0.456, 0.406], np.float32)
SPREAD = np.array([0.229, 0.224, 0.225], np.float32)


class SegmentationModel:
    """An ONNX model that has shown that it runs, and the classes that are left out."""

    def __init__(self, path: str, classes: str) -> None:
        """classes: their numbers, as in '63,64'. Raises ConfigError for a model of no use."""
        self._path = path
        self._classes = [int(number) for number in classes.split(',')]
        self._session = _session(path)
        inputs = self._session.get_inputs()
        shape = list(inputs[0].shape) if len(inputs) == 1 else []
        fits = [_open(side) or side == wanted for side, wanted in zip(shape, (1, 3), strict=False)]
        if len(shape) != 4 or not all(fits) or inputs[0].type != 'tensor(float)':
            takes = ' and '.join(f'{"x".join(map(str, each.shape))} {each.type}'
                                 for each in inputs)
            raise ConfigError(f'the segmentation model {path} takes {takes or "nothing"}; export '
                              f'it with one input of 1x3xHxW float32')
        self._input = inputs[0].name
        self._size = (SIZE[0] if _open(shape[3]) else shape[3],
                      SIZE[1] if _open(shape[2]) else shape[2])
        # what can go wrong goes wrong now, and not in the middle of the drive
        self.vehicle(np.zeros((self._size[1], self._size[0]), np.uint8))

    def vehicle(self, image: Grey) -> Mask:
        """Return where an image (height, width) shows one of the classes.

        The result is (h, w), at the resolution of the model's output.
        """
        small = cv2.resize(image, self._size, interpolation=cv2.INTER_AREA)
        planes = (small.astype(np.float32) / 255 - MEAN[:, None, None]) / SPREAD[:, None, None]
        try:
            # the first output is the main one, others are for training
            output = np.asarray(self._session.run(None, {self._input: planes[None]})[0])
        except Exception as error:  # onnxruntime's have no parent in common
            raise ConfigError(f'the segmentation model {self._path} does not run '
                              f'({one_line(error)}); export it anew') from error
        return self._decided(output)

    def _decided(self, output: npt.NDArray[Any]) -> Mask:
        """Return (h, w): where logits (1, C, h, w) or labels (1, h, w) say one of the classes."""
        shape = output.shape
        if output.ndim == 4 and shape[0] == 1 and shape[1] > 1 and output.dtype.kind == 'f':
            if max(self._classes) >= shape[1]:
                raise ConfigError(
                    f'the segmentation model {self._path} has the classes 0 to {shape[1] - 1}: '
                    f'set mask.segmentation_classes to those of the own car, not to '
                    f'{",".join(map(str, self._classes))}')
            # 15 times as fast as argmax, and false for NaN
            return np.asarray(output[0][self._classes].max(axis=0) == output[0].max(axis=0))
        if output.ndim in (3, 4) and set(shape[:-2]) == {1} and output.dtype.kind in 'iu':
            return np.isin(output.reshape(shape[-2:]), self._classes)
        raise ConfigError(
            f'the segmentation model {self._path} gives {"x".join(map(str, shape))} '
            f'{output.dtype}; export it with 1xCxHxW logits (float) or 1xHxW labels (integer) as '
            f'its first output')


class SegmentationMask:
    """Counts, pixel by pixel, in how many of the sampled images the vehicle is seen."""

    def __init__(self, model: SegmentationModel) -> None:
        self._model = model
        self._votes: npt.NDArray[np.float32] | None = None
        self._count = 0
        self._asked_ns = -math.inf

    def push(self, image: Grey, stamp_ns: int) -> bool:
        """Take an image (height, width) of the moving car; return whether it was asked about."""
        if self._count == VOTES or abs(stamp_ns - self._asked_ns) < 1e9 * PERIOD:
            return False
        self._asked_ns = stamp_ns
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
        # linear between the output's pixels: its outline is smoother than they are
        share = cv2.resize(self._votes / np.float32(self._count), shape[::-1],
                           interpolation=cv2.INTER_LINEAR)
        side = 2 * math.ceil(MARGIN * shape[1]) + 1
        whole = cv2.dilate((share >= 0.5).astype(np.uint8), np.ones((side, side), np.uint8))
        return np.asarray(whole > 0)

    def warning(self) -> str | None:
        """Return what the user should know of the outcome, in one line."""
        found = self._found()
        cure = 'check mask.segmentation_classes'
        if found is None:
            return None
        if not found.any():
            return f'the segmentation model sees no part of the own car; if there is one, {cure}'
        if found.mean() > LARGEST:
            return (f'the segmentation model takes {100 * found.mean():.0f} % of the picture for '
                    f'the own car, which is not believed; {cure}')
        return None

    def _found(self) -> Mask | None:
        """Return (h, w) of the model's output: where the vehicle is; None before any vote."""
        return None if self._votes is None else self._votes >= 0.5 * self._count


def open_segmentation(config: MaskConfig) -> SegmentationModel | None:
    """Return the model that the settings name, None if none; raises ConfigError."""
    if not config.segmentation:
        return None
    return _opened(config.segmentation, config.segmentation_classes)


@lru_cache(maxsize=1)
def _opened(path: str, classes: str) -> SegmentationModel:
    # kept: a node that begins anew after a reset must not read it again while images wait
    return SegmentationModel(path, classes)


def _session(path: str) -> Any:
    """Return an onnxruntime session; raises ConfigError."""
    file = Path(path)
    with suppress(RuntimeError):  # there is no such user: there will be no such file
        file = file.expanduser()
    if not file.is_file():
        raise ConfigError(f'there is no segmentation model {path}; check the path')
    try:
        import onnxruntime
    except ImportError as error:
        raise ConfigError('a segmentation model needs onnxruntime, which is not installed: '
                          'pip install onnxruntime') from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = THREADS
    # between two images its threads would otherwise keep a core busy for nothing
    options.add_session_config_entry('session.intra_op.allow_spinning', '0')
    options.log_severity_level = 4  # what is wrong comes as our own error
    onnxruntime.set_default_logger_severity(4)
    try:
        return onnxruntime.InferenceSession(str(file), options, ['CPUExecutionProvider'])
    except Exception as error:  # onnxruntime's have no parent in common
        raise ConfigError(f'{path} is no ONNX model that onnxruntime can load '
                          f'({one_line(error)}); export it anew, or upgrade onnxruntime'
                          ) from error


def _open(side: Any) -> bool:
    """Tell whether a dimension is left open."""
    return not isinstance(side, int) or side <= 0
