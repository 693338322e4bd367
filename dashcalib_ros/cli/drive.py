# SPDX-License-Identifier: Apache-2.0
"""From a command's arguments to its settings and its drive."""
from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dashcalib_ros import session
from dashcalib_ros.camera import searched
from dashcalib_ros.config import Config, known_of
from dashcalib_ros.errors import ConfigError, InputError, shortened
from dashcalib_ros.limits import YAML_BYTES, parse_yaml, read_text
from dashcalib_ros.session import Recording

# --turns sets both, so that exactly this number of turns is used; --workers of batch is another
FLAGS = {'turns': ('turns.wanted', 'turns.at_most'), 'thorough': ('turns.thorough',),
         'seed': ('seed',), 'turn_workers': ('workers',),
         'segmentation': ('mask.segmentation',), 'model': ('model',),
         'speed': ('mount.speed_kmh',), 'mount': ('mount.enabled',),
         'gyro_scale_sigma': ('motion.gyro_scale_sigma',)}


def read_config(args: argparse.Namespace) -> Config:
    """Return the settings from --config, --set, and --turns and the like; later ones count."""
    path: Path | None = getattr(args, 'config', None)
    config = Config() if path is None else Config.of(_read_yaml(path))
    changes = parse_settings(getattr(args, 'set', []))
    changes.update({name: getattr(args, flag) for flag, names in FLAGS.items() for name in names
                    if getattr(args, flag, None) is not None})
    changes |= known_of(getattr(args, 'known', []))
    config = config.replace(changes)
    searched(config.model)  # raises for an unknown model before any work begins
    return config


def parse_settings(pairs: Sequence[str]) -> dict[str, Any]:
    """Parse KEY=VALUE pairs; values are YAML. Raises ConfigError."""
    changes: dict[str, Any] = {}
    for pair in pairs:
        key, equals, text = pair.partition('=')
        if not equals or not key.strip():
            raise ConfigError('E-SETTING-FORM', f'--set needs KEY=VALUE, such as '
                                                f'turns.wanted=4, not {shortened(pair)!r}')
        what = f'--set {shortened(pair)}: the value'
        try:
            changes[key.strip()] = parse_yaml(text, what)
        except InputError as error:
            raise ConfigError(error.code, f'{error}: use a plain number, a word, true or '
                                          f'false') from error
    return changes


def _read_yaml(path: Path) -> Mapping[str, Any]:
    try:
        what = f'the configuration {path}'
        data = parse_yaml(read_text(path, YAML_BYTES, what), what)
    except InputError as error:
        raise ConfigError(error.code, str(error)) from error
    if data is None:
        return {}
    if not isinstance(data, Mapping):
        raise ConfigError('E-CONFIG-EMPTY', f'the configuration {path} has no settings; write '
                                            f'lines like turns.wanted: 4')
    return data


def open_drive(args: argparse.Namespace) -> Recording:
    """Open the drive, the mask and the sensors that the arguments name. Raises InputError."""
    duration_s = args.duration
    if args.end is not None:
        duration_s = args.end - args.start
        if duration_s <= 0:
            raise InputError('E-INPUT-DURATION', f'--end {args.end:g} s is not after --start '
                                                 f'{args.start:g} s')
    topics = {name: getattr(args, name, None) for name in ('imu', 'gps', 'odom')}
    return session.open_drive(args.input, args.topic, args.fps, args.start, duration_s,
                              args.mask, getattr(args, 'motion', None), topics, args.crop,
                              args.stamps, getattr(args, 'columns', None),
                              getattr(args, 'sensor_offset', 0.0),
                              getattr(args, 'temperature', None))
