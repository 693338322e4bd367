"""From a command's arguments to its settings and its drive, which goes to the calibrator."""
from __future__ import annotations

import argparse
import signal
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dashcalib_ros.arrays import Mask
from dashcalib_ros.calibrator import Calibrator
from dashcalib_ros.camera import searched
from dashcalib_ros.cli.program import handling
from dashcalib_ros.cli.terminal import Stages
from dashcalib_ros.config import Config
from dashcalib_ros.errors import ConfigError, InputError, counted, shortened
from dashcalib_ros.input import FrameSource
from dashcalib_ros.input.decode import read_mask
from dashcalib_ros.input.inputs import open_frames
from dashcalib_ros.input.motion import SensorStream
from dashcalib_ros.judge import Calibration
from dashcalib_ros.limits import YAML_BYTES, parse_yaml, read_text
from dashcalib_ros.recorded import Taker, drive_motion, pushed, with_source

# --turns sets both, so that exactly this number of turns is used
FLAGS = {'turns': ('turns.wanted', 'turns.at_most'), 'seed': ('seed',), 'threads': ('threads',),
         'segmentation': ('mask.segmentation',), 'model': ('model',),
         'speed': ('mount.speed_kmh',), 'mount': ('mount.enabled',),
         'gyro_scale_sigma': ('motion.gyro_scale_sigma',)}


def read_config(args: argparse.Namespace) -> Config:
    """Return the settings from --config, --set, and --turns and the like; later ones count."""
    path: Path | None = getattr(args, 'config', None)
    config = Config() if path is None else Config.from_mapping(_read_yaml(path))
    changes = parse_settings(getattr(args, 'set', []))
    changes.update({name: getattr(args, flag) for flag, names in FLAGS.items() for name in names
                    if getattr(args, flag, None) is not None})
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


def open_drive(args: argparse.Namespace) -> tuple[FrameSource, Mask | None]:
    """Open the drive and the mask that the arguments name. Raises InputError."""
    mask = None if args.mask is None else read_mask(args.mask)
    return open_frames(args.input, args.topic, args.fps, args.start, args.duration), mask


def read_sensors(args: argparse.Namespace) -> SensorStream | None:
    """Return the sensors' data of --motion, else of the drive's bags; None where there is none.

    Raises InputError for a file of another kind, and for a topic that does not exist.
    """
    return drive_motion(args.input, args.motion,
                        {name: getattr(args, name) for name in ('imu', 'gps', 'odom')},
                        args.start, args.topic)


@contextmanager
def open_calibrator(config: Config, mask: Mask | None, verbose: bool) -> Iterator[Calibrator]:
    """Make a calibrator that is closed at the end, even if Ctrl-C is pressed again meanwhile."""
    calibrator = Calibrator(config, mask, verbose)
    try:
        yield calibrator
    finally:
        with handling(signal.SIG_IGN, signal.SIGINT, signal.SIGTERM):
            calibrator.close()


def feed(taker: Taker, source: FrameSource, mask: Mask | None, stages: Stages) -> int:
    """Push every frame of the drive; return how many there were."""
    frames = 0
    stages.show('reading', None)
    for frames in pushed(taker, source, mask):
        stages.show('reading', frames / source.count if source.count else None,
                    f'frame {frames}, {counted(len(taker.turns()), "turn")}')
    return frames


def calibrate(source: FrameSource, config: Config, mask: Mask | None, verbose: bool,
              stages: Stages, motion: SensorStream | None = None) -> Calibration:
    """Calibrate a whole drive; the input's name and warnings are in the result."""
    with open_calibrator(config, mask, verbose) as calibrator:
        if motion is not None:
            calibrator.sense(motion)
        feed(calibrator, source, mask, stages)
        calibration: Calibration = calibrator.calibrate(stages.show)
    return with_source(calibration, source)
