"""The arguments of every command."""
from __future__ import annotations

import argparse
import importlib
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from dashcalib_ros.errors import DashcalibError
from dashcalib_ros.standard_streams import write_stdout

PROGRAM = 'dashcalib'
INPUT_HELP = ('a ROS 2 bag (folder, .mcap, .db3), a ROS 1 .bag, a video, '
              'or a folder of images')
EXIT_HELP = ('exit codes: 0 accepted; 3 weak or refused (the input was fine, the evidence was '
             'not enough); 2 bad input or usage')


class UsageError(DashcalibError):
    """The arguments are wrong."""


class Parser(argparse.ArgumentParser):
    """argparse's parser; usage errors are one line, and an unusable stdout is an error."""

    def __init__(self, **options: Any) -> None:
        super().__init__(allow_abbrev=False, **options)

    def error(self, message: str) -> NoReturn:
        """Raise UsageError: one line that names --help."""
        raise UsageError(f'{message}; see {self.prog} --help')

    def print_help(self, file: Any = None) -> None:
        """Print the help on stdout. Raises OutputError where it cannot."""
        write_stdout(self.format_help().rstrip('\n'))


class Version(argparse.Action):
    """--version; looks the version up only when it is used."""

    def __init__(self, option_strings: Sequence[str], dest: str) -> None:
        super().__init__(option_strings, dest, nargs=0, help='print the version and exit')

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        """Print the installed package's version."""
        from importlib.metadata import PackageNotFoundError, version
        try:
            found = version('dashcalib_ros')
        except PackageNotFoundError:
            found = 'not installed (running from its sources)'
        write_stdout(f'{PROGRAM} {found}')
        parser.exit()


def make_parser() -> Parser:
    """Return the parser; the parsed arguments have the function to call with them as `command`."""
    parser = Parser(
        prog=PROGRAM, epilog=EXIT_HELP,
        description='Calibrates a dashcam from the turns the car takes anyway.')
    parser.add_argument('--version', action=Version)
    commands = parser.add_subparsers(metavar='COMMAND', required=True, parser_class=Parser)
    _add_run(commands)
    _add_turns(commands)
    _add_demo(commands)
    _add_compare(commands)
    _add_export(commands)
    return parser


def _add_run(commands: Any) -> None:
    parser = _command(commands, 'run', 'calibrate a recorded drive',
                      'Writes calibration.yaml (accepted), result.json and report.html to DIR.')
    _add_drive_arguments(parser)
    _add_model(parser)
    parser.add_argument('--threads', type=int, metavar='N',
                        help='processes that reconstruct turns side by side; the result is the '
                             'same with any')
    parser.add_argument('--write-bag', type=Path, metavar='OUT',
                        help='when accepted: write a copy of the bag INPUT with a camera_info for '
                             'each image')
    _add_out(parser, 'calibration')


def _add_turns(commands: Any) -> None:
    parser = _command(commands, 'turns', 'find the turns of a drive, without calibrating',
                      'Lists the turns a calibration would use, best first.')
    _add_drive_arguments(parser)
    parser.add_argument('--json', action='store_true', help='print JSON')


def _add_demo(commands: Any) -> None:
    parser = _command(commands, 'demo', 'render a drive, calibrate it, compare with the truth',
                      'Renders a drive with a known lens into a ROS 2 bag and calibrates that.')
    _add_model(parser)
    _add_seed(parser)
    _add_verbose(parser)
    _add_out(parser, 'demo')
    parser.add_argument('--keep-bag', action='store_true', help='leave the bag in DIR/bag')


def _add_compare(commands: Any) -> None:
    parser = _command(commands, 'compare', 'compare two calibrations',
                      'Per-parameter difference, and the RMS distance in pixels between the '
                      'images of the same rays over the image, best common rotation removed.')
    what = 'a result.json (or its folder), a camera_info YAML or a truth JSON'
    parser.add_argument('a', metavar='A', type=Path, help=what)
    parser.add_argument('b', metavar='B', type=Path, help=f'the reference: {what}')
    parser.add_argument('--json', action='store_true', help='print JSON')


def _add_export(commands: Any) -> None:
    parser = _command(commands, 'export', "write a calibration as another program's camera file",
                      'Prints the camera in the format of another program, or writes it to FILE.')
    parser.add_argument('calibration', metavar='CALIBRATION', type=Path,
                        help='a result.json (or its folder), a camera_info YAML or a truth JSON')
    # the names are not taken from the table of exports: that would load numpy and OpenCV
    parser.add_argument('--to', required=True, metavar='KIND',
                        help='opencv, colmap, kalibr, opensfm, nerfstudio or ros')
    view = parser.add_mutually_exclusive_group()
    view.add_argument('--size', type=_size, metavar='WxH',
                      help='for pictures that were resized to this')
    view.add_argument('--crop', type=_crop, metavar='X,Y,W,H',
                      help='for this part of the pictures')
    parser.add_argument('--out', type=Path, metavar='FILE', help='default: standard output')


def _size(text: str) -> tuple[int, int]:
    """Return a size that is given as WxH."""
    width, height = _whole_numbers(text, 'x', 2, '1280x720')
    return width, height


def _crop(text: str) -> list[int]:
    """Return a part of the picture that is given as X,Y,W,H."""
    return _whole_numbers(text, ',', 4, '0,100,1280,520')


def _whole_numbers(text: str, between: str, count: int, like: str) -> list[int]:
    parts = text.lower().split(between)
    if len(parts) != count or not all(part.strip().isdecimal() for part in parts):
        raise argparse.ArgumentTypeError(f'{text!r} is not like {like}')
    return [int(part) for part in parts]


def _command(commands: Any, name: str, summary: str, description: str) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = commands.add_parser(
        name, help=summary, description=description, epilog=EXIT_HELP)
    parser.set_defaults(command=_lazily(name))
    return parser


def _lazily(name: str) -> Callable[[argparse.Namespace], int]:
    """Return the command's function, which imports its module, and numpy's, only when called."""
    def command(args: argparse.Namespace) -> int:
        code: int = getattr(importlib.import_module(f'dashcalib_ros.cli.{name}'), name)(args)
        return code
    return command


def _add_drive_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('input', metavar='INPUT', help=INPUT_HELP)
    parser.add_argument('--topic', metavar='T', help="the bag's image topic")
    parser.add_argument('--fps', type=_rate, metavar='F', help='rate of a video or image folder')
    parser.add_argument('--turns', type=int, metavar='N', help='how many turns are wanted')
    parser.add_argument('--mask', type=Path, metavar='PNG',
                        help='black pixels are not used; as large as the images')
    parser.add_argument('--segmentation', metavar='MODEL.onnx',
                        help='a segmentation network that finds the own car, used in addition to '
                             'the automatic mask')
    parser.add_argument('--config', type=Path, metavar='YAML', help='settings from a file')
    parser.add_argument('--set', action='append', default=[], metavar='KEY=VALUE',
                        help='one setting, over those of --config; may be repeated')
    _add_seed(parser)
    _add_verbose(parser)


def _add_model(parser: argparse.ArgumentParser) -> None:
    # the names are not taken from the table of models: that would load numpy and OpenCV
    parser.add_argument('--model', metavar='NAME',
                        help='of the lens: radial, brown, fisheye, or auto: the one that the '
                             'turns prove (default)')


def _add_seed(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--seed', type=int, metavar='S', help='same input and seed: same result')


def _add_verbose(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--verbose', action='store_true', help="show COLMAP's own log")


def _add_out(parser: argparse.ArgumentParser, default: str) -> None:
    parser.add_argument('--out', type=Path, default=Path(default), metavar='DIR',
                        help=f'where the results go (default: ./{default})')


def _rate(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f'must be a positive number, not {text!r}')
    return value
