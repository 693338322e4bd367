"""From --config, --set and the dedicated flags to a Config and a mask."""
from __future__ import annotations

import argparse
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml

from dashcalib_ros.config import Config
from dashcalib_ros.errors import ConfigError, InputError
from dashcalib_ros.frames import Frame

FLAGS = {'turns': 'turns.wanted', 'seed': 'seed', 'threads': 'threads'}
EXPONENT = re.compile(r'[-+]?\d+(\.\d*)?[eE][-+]?\d+')  # 1e-3, a word to YAML 1.1


def read_config(args: argparse.Namespace) -> Config:
    """Return the settings: --config, then --set over it, then --turns, --seed and --threads."""
    path: Path | None = getattr(args, 'config', None)
    config = Config() if path is None else Config.from_mapping(_read_yaml(path))
    changes = parse_settings(getattr(args, 'set', []))
    changes.update({name: getattr(args, flag) for flag, name in FLAGS.items()
                    if getattr(args, flag, None) is not None})
    return config.replace(changes)


def parse_settings(pairs: Sequence[str]) -> dict[str, Any]:
    """Parse KEY=VALUE pairs; values are YAML. Raises ConfigError."""
    changes: dict[str, Any] = {}
    for pair in pairs:
        key, equals, text = pair.partition('=')
        if not equals or not key.strip():
            raise ConfigError(f'--set needs KEY=VALUE (turns.wanted=4), not {pair!r}')
        try:
            changes[key.strip()] = _numbers(yaml.safe_load(text))
        except (yaml.YAMLError, ValueError) as error:
            raise ConfigError(f'--set {pair}: the value is not valid YAML; '
                              'write a plain number, true or false') from error
    return changes


def read_mask(path: Path | None) -> npt.NDArray[np.bool_] | None:
    """Read a mask picture: True where it is not black. Raises InputError."""
    if path is None:
        return None
    import cv2
    try:
        data = np.fromfile(path, np.uint8)
    except OSError as error:
        raise InputError(f'cannot read the mask {path} ({error.strerror}); '
                         'check the path') from error
    picture = None
    if data.size:
        picture = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    if picture is None:
        raise InputError(f'the mask {path} is no picture; give a PNG, black where the image is '
                         'not to be used')
    mask: npt.NDArray[np.bool_] = np.asarray(picture) > 0
    if not mask.any():
        raise InputError(f'the mask {path} is all black, nothing is left of the image; '
                         'make the part to use white')
    return mask


def check_mask(mask: npt.NDArray[np.bool_] | None, frame: Frame) -> None:
    """Raise InputError unless the mask is as large as the image."""
    if mask is not None and (size := mask.shape[::-1]) != frame.size:
        raise InputError(f'the mask is {size[0]}x{size[1]} and the images are '
                         f'{frame.size[0]}x{frame.size[1]}; make the mask as large as the images')


def _read_yaml(path: Path) -> Mapping[str, Any]:
    try:
        data = yaml.safe_load(path.read_bytes())
    except OSError as error:
        raise ConfigError(f'cannot read the configuration {path} ({error.strerror}); '
                          'check the path') from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, 'problem_mark', None)
        where = f' at line {mark.line + 1}' if mark else ''
        raise ConfigError(f'the configuration {path} is not valid YAML{where}; '
                          'write lines like turns.wanted: 4') from error
    if data is None:
        return {}
    if not isinstance(data, Mapping):
        raise ConfigError(f'the configuration {path} has no settings; '
                          'write lines like turns.wanted: 4')
    return {key: _numbers(value) for key, value in data.items()}


def _numbers(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _numbers(item) for key, item in value.items()}
    if isinstance(value, str) and EXPONENT.fullmatch(value):
        return float(value)
    return value
