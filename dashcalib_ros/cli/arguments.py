"""The arguments and the exit codes of every command."""
from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from dashcalib_ros.errors import DashcalibError
from dashcalib_ros.standard_streams import write_stdout

PROGRAM = 'dashcalib'
# exit codes
ACCEPTED = 0
WRONG = 1  # of check: the calibration does not explain the drive
BAD_INPUT = 2  # or bad usage: one line on stderr says what and the cure
NOT_ENOUGH = 3  # weak or refused: the input was fine, the evidence was not enough
INTERRUPTED = 130  # Ctrl-C or SIGTERM, as shells have it
INPUT_HELP = ('a ROS 2 bag (folder, .mcap, .db3), a ROS 1 .bag, a video, or a folder of images; '
              "several of one camera, in this order; or a folder of videos, or a pattern "
              "('clips/*.mp4'): bags by their time, all else by name")
EXIT_HELP = ('exit codes: 0 accepted; 3 weak or refused (the input was fine, the evidence was '
             'not enough); 2 bad input or usage')
CALIBRATION_HELP = ('result.json (or its folder), calibration.yaml, a file of ROS, OpenCV, '
                    'Kalibr, COLMAP, nerfstudio, OpenSfM or mrcal, a JSON of fx, fy, cx, cy, k1, '
                    'k2 ..., width and height, or a bag with camera_info; FILE:NAME for one of '
                    'several cameras')
SHORT_EXIT_HELP = 'exit codes: 0 done; 2 bad input or usage'
CHECK_EXIT_HELP = 'exit codes: 0 right; 1 wrong; 3 the drive cannot tell; 2 bad input or usage'
BATCH_EXIT_HELP = ('exit codes: 0 every clip was read and no camera refused; 3 some were not; '
                   '2 bad manifest or usage')
# the names of models and exports are not taken from their tables: that would load OpenCV
MODELS = ('auto', 'radial', 'brown', 'fisheye')
KINDS = ('opencv', 'colmap', 'kalibr', 'opensfm', 'nerfstudio', 'mrcal', 'ros', 'rays', 'maps')

SHARED: dict[str, dict[str, Any]] = {
    '--config': {'type': Path, 'metavar': 'YAML', 'help': 'settings from a file'},
    '--set': {'action': 'append', 'default': [], 'metavar': 'KEY=VALUE',
              'help': 'one setting, over those of --config; may be repeated'},
    '--model': {'metavar': 'NAME', 'help': 'of the lens: radial, brown, fisheye, or auto: the one '
                                           'that the turns prove (default)'},
    '--seed': {'type': int, 'metavar': 'S', 'help': 'same input and seed: same result'},
    '--quiet': {'action': 'store_true',
                'help': 'no progress and no summary: only warnings and errors'},
    '--verbose': {'action': 'store_true', 'help': "show COLMAP's own log"}}


def exit_code(verdict: str) -> int:
    """Return the exit code of a verdict."""
    return ACCEPTED if verdict == 'accepted' else NOT_ENOUGH


class UsageError(DashcalibError):
    """The arguments are wrong."""


class _Lines(argparse.HelpFormatter):
    """Keeps the lines of an epilog apart."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return '\n'.join(super(_Lines, self)._fill_text(line, width, indent)
                         for line in text.split('\n'))


class Parser(argparse.ArgumentParser):
    """argparse's parser; usage errors are one line, and an unusable stdout is an error."""

    def __init__(self, **options: Any) -> None:
        super().__init__(allow_abbrev=False, formatter_class=_Lines, **options)

    def error(self, message: str) -> NoReturn:
        """Raise UsageError: one line that names --help."""
        raise UsageError(f'{message}; see {self.prog} --help')

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """Parse them all: what a command does not know must name that command's --help."""
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f'unrecognized arguments: {" ".join(unknown)}')
        return found, []

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
    """Return the parser; the parsed arguments have the command's name as `command`."""
    parser = Parser(
        prog=PROGRAM, epilog=f'{PROGRAM} COMMAND --help tells more\n{EXIT_HELP}',
        description='Calibrates a dashcam from the turns the car takes anyway.')
    parser.add_argument('--version', action=Version)
    commands = parser.add_subparsers(dest='command', metavar='COMMAND', required=True,
                                     parser_class=Parser)
    _add_run(commands)
    _add_turns(commands)
    _add_demo(commands)
    _add_compare(commands)
    _add_export(commands)
    _add_check(commands)
    _add_batch(commands)
    return parser


def _add_run(commands: Any) -> None:
    parser = _command(
        commands, 'run', 'calibrate a recorded drive',
        'Finds the turns of a drive, reconstructs the best and calibrates the camera from them. '
        'Writes result.json, report.html and, when accepted, calibration.yaml to DIR.',
        "dashcalib run 'clips/*.mp4' --out calibration", EXIT_HELP)
    _add_drive_arguments(parser)
    _add_motion(parser)
    _add_shared(parser, '--model', '--seed')
    parser.add_argument('--threads', type=int, metavar='N',
                        help='processes that reconstruct turns side by side; the result is the '
                             'same with any')
    parser.add_argument('--speed', type=POSITIVE, metavar='KMH',
                        help='on straight stretches, constant: tells how high the camera sits')
    parser.add_argument('--no-mount', action='store_false', default=None, dest='mount',
                        help='do not say how the camera sits on the car')
    parser.add_argument('--write-bag', type=Path, metavar='OUT',
                        help='when accepted: write a copy of the one bag INPUT with a '
                             'camera_info for each image')
    _add_out(parser, 'calibration', 'the results are several files: give a folder; '
                                    '--json - prints result.json')
    parser.add_argument('--json', choices=('-',), metavar='-',
                        help='print result.json on stdout, all else on stderr')
    _add_shared(parser, '--quiet', '--verbose')


def _add_turns(commands: Any) -> None:
    parser = _command(commands, 'turns', 'find the turns of a drive, without calibrating',
                      'Lists the turns that a calibration would choose from, best first.',
                      'dashcalib turns drive.mp4 --start 60 --duration 300')
    _add_drive_arguments(parser)
    parser.add_argument('--json', action='store_true', help='print JSON')
    parser.add_argument('--quiet', action='store_true', help='no progress')
    # they were taken here before, and change nothing
    parser.add_argument('--seed', type=int, help=argparse.SUPPRESS)
    parser.add_argument('--verbose', action='store_true', help=argparse.SUPPRESS)


def _add_demo(commands: Any) -> None:
    parser = _command(commands, 'demo', 'render a drive, calibrate it, compare with the truth',
                      'Renders a drive with a known lens into a ROS 2 bag, calibrates that and '
                      'compares the result with the truth.',
                      'dashcalib demo --keep-bag --out demo', EXIT_HELP)
    _add_shared(parser, '--model', '--seed')
    _add_out(parser, 'demo', 'the results are several files: give a folder')
    parser.add_argument('--keep-bag', action='store_true', help='leave the bag in DIR/bag')
    _add_shared(parser, '--quiet', '--verbose')


def _add_compare(commands: Any) -> None:
    parser = _command(commands, 'compare', 'compare two calibrations',
                      'How far apart both see a ray, in pixels over the picture, best common '
                      'rotation removed; whether that can be told, and whether it matters.',
                      'dashcalib compare calibration /etc/camera/old.yaml --html compare.html')
    parser.add_argument('a', metavar='A', type=Path, help=CALIBRATION_HELP)
    parser.add_argument('b', metavar='B', type=Path, help='the reference: the same kinds of files')
    parser.add_argument('--html', type=path_or('give a file'), metavar='FILE',
                        help='write a page with maps of the difference, in px and in sigmas')
    parser.add_argument('--json', action='store_true', help='print JSON')


def _add_export(commands: Any) -> None:
    parser = _command(commands, 'export', "write a calibration as another program's camera file",
                      'Prints the camera in the format of another program, or writes it to FILE.',
                      'dashcalib export calibration --to colmap --out cameras.txt')
    parser.add_argument('calibration', metavar='CALIBRATION', type=Path,
                        help=CALIBRATION_HELP)
    kind = parser.add_argument('--to', required=True, metavar='KIND',
                               help=f'{", ".join(KINDS[:-1])} or {KINDS[-1]}')
    _completed(kind, KINDS)
    view = parser.add_mutually_exclusive_group()
    view.add_argument('--size', type=whole_numbers('x', 2, '1280x720'), metavar='WxH',
                      help='for pictures that were resized to this')
    view.add_argument('--crop', type=whole_numbers(',', 4, '0,100,1280,520'), metavar='X,Y,W,H',
                      help='for this part of the pictures')
    parser.add_argument('--out', type=path_or('leave --out away for standard output'),
                        metavar='FILE', help='default: standard output')


def _add_check(commands: Any) -> None:
    parser = _command(commands, 'check', 'tell whether a calibration explains a drive',
                      'Says whether CALIBRATION is right (to so many pixels), wrong (in which way '
                      'and by how much), or whether the drive cannot tell.',
                      'dashcalib check calibration drive.mcap', CHECK_EXIT_HELP)
    parser.add_argument('calibration', metavar='CALIBRATION', type=Path,
                        help=CALIBRATION_HELP)
    _add_drive_arguments(parser, '*', 'left away: the bag that CALIBRATION is; else: ')
    _add_motion(parser)
    _add_shared(parser, '--model', '--seed')
    parser.add_argument('--poses', type=Path, metavar='FILE',
                        help="true poses, in KITTI's or TUM's format, or a GPS track (GPX, a bag "
                             'with NavSatFix): compare the rotation and the scale that each '
                             'camera finds with them')
    parser.add_argument('--mount', action='store_true', dest='mounting',
                        help='a camera that was moved on the car is wrong, too')
    parser.add_argument('--out', type=path_or('--out is a folder'), metavar='DIR',
                        help='with --poses: write a plot of the paths, and the paths for evo')
    parser.add_argument('--json', action='store_true', help='print JSON')
    parser.add_argument('--quiet', action='store_true', help='no progress')
    _add_shared(parser, '--verbose')


def _add_batch(commands: Any) -> None:
    parser = _command(commands, 'batch', 'calibrate many cameras from many clips',
                      'Writes to DIR: a folder for each camera, tables of cameras and of clips, '
                      'overview.html. Started again, it does what is missing.',
                      'dashcalib batch clips.csv --out fleet', BATCH_EXIT_HELP)
    parser.add_argument('manifest', metavar='MANIFEST',
                        help='.csv, .jsonl or .parquet with a column clip, and where known '
                             'camera, make, fps, topic, time; a folder of clips; or a glob in '
                             'quotes')
    parser.add_argument('--out', required=True, metavar='DIR',
                        help='a folder, or an address such as s3://bucket/fleet')
    parser.add_argument('--group-by', metavar='REGEX',
                        help="takes the camera from a clip's name: its first group, or its groups "
                             '(?P<camera>...) and (?P<make>...)')
    where = parser.add_mutually_exclusive_group()
    where.add_argument('--workers', type=_count, metavar='N',
                       help='processes (default: one a core, while memory lasts); the result is '
                            'the same with any')
    where.add_argument('--address', metavar='A', help="a Ray cluster's; auto: the one here")
    where.add_argument('--shard', metavar='I/N',
                       help='do the I-th of N parts, with one process; a run without --shard then '
                            'makes the tables')
    _add_shared(parser, '--config', '--set', '--model', '--seed', '--quiet')


def _count(text: str) -> int:
    if not (text.isdecimal() and 1 <= int(text) <= 10_000):
        raise argparse.ArgumentTypeError(f'must be a number from 1 on, not {text!r}')
    return int(text)


def _command(commands: Any, name: str, summary: str, description: str, example: str,
             exit_codes: str = SHORT_EXIT_HELP) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = commands.add_parser(
        name, help=summary, description=description, epilog=f'example: {example}\n{exit_codes}')
    return parser


def _add_drive_arguments(parser: argparse.ArgumentParser, count: str = '+', more: str = ''
                         ) -> None:
    parser.add_argument('input', metavar='INPUT', nargs=count, help=more + INPUT_HELP)
    parser.add_argument('--topic', metavar='T', help="the bag's image topic")
    parser.add_argument('--fps', type=POSITIVE, metavar='F',
                        help='rate of a video or image folder')
    parser.add_argument('--start', type=SECONDS, default=0.0, metavar='S',
                        help='leave out the first S seconds of the drive')
    parser.add_argument('--duration', type=POSITIVE, metavar='S',
                        help='use S seconds of the drive')
    parser.add_argument('--turns', type=int, metavar='N', help='how many turns are wanted')
    parser.add_argument('--mask', type=Path, metavar='PNG',
                        help='black pixels are not used; as large as the images')
    parser.add_argument('--segmentation', metavar='MODEL.onnx',
                        help='a segmentation network that finds the own car, used in addition to '
                             'the automatic mask')
    _add_shared(parser, '--config', '--set')


def _add_motion(parser: argparse.ArgumentParser) -> None:
    """Add the options of the car's own sensors, which say how much it turned."""
    parser.add_argument('--motion', type=Path, metavar='FILE',
                        help="the car's own sensors: a CSV (head line: stamp_s from the first "
                             'image on, and any of gyro_x, gyro_y, gyro_z [rad/s], speed [m/s], '
                             'latitude, longitude, altitude), a GPX, a KITTI oxts folder, or a '
                             'video that has them inside')
    for name, what in (('imu', 'Imu'), ('gps', 'NavSatFix'), ('odom', 'Odometry or Twist')):
        parser.add_argument(f'--{name}', metavar='TOPIC',
                            help=f"the bag's {what} topic, where it has several")
    parser.add_argument('--gyro-scale-sigma', type=number('0 or more', lambda v: v >= 0),
                        metavar='S', help="how far the gyro's angles may be off, of them: 0.03 "
                                          'unless given, a calibrated one has 0.001')


def _add_shared(parser: argparse.ArgumentParser, *names: str) -> None:
    """Add options that several commands have."""
    for name in names:
        action = parser.add_argument(name, **SHARED[name])
        if name == '--model':
            _completed(action, MODELS)


def _completed(action: argparse.Action, names: Sequence[str]) -> None:
    """Let the shell complete these names; argcomplete looks for this attribute."""
    action.completer = lambda **_: names  # type: ignore[attr-defined]


def _add_out(parser: argparse.ArgumentParser, default: str, cure: str) -> None:
    parser.add_argument('--out', type=path_or(cure), default=Path(default), metavar='DIR',
                        help=f'where the results go (default: ./{default})')


def whole_numbers(between: str, count: int, like: str) -> Callable[[str], tuple[int, ...]]:
    """Return a type of argument: so many whole numbers, such as a size or a part of a picture."""
    def numbers(text: str) -> tuple[int, ...]:
        parts = text.lower().split(between)
        if len(parts) != count or not all(part.strip().isdecimal() for part in parts):
            raise argparse.ArgumentTypeError(f'{text!r} is not like {like}')
        return tuple(int(part) for part in parts)
    return numbers


def number(what: str, fits: Callable[[float], bool]) -> Callable[[str], float]:
    """Return a type of argument: a finite number that fits. what: it must be."""
    def value(text: str) -> float:
        try:
            found = float(text)
        except ValueError:
            found = math.nan
        if not (math.isfinite(found) and fits(found)):
            raise argparse.ArgumentTypeError(f'must be {what}, not {text!r}')
        return found
    return value


SECONDS = number('0 or more seconds', lambda value: value >= 0)
POSITIVE = number('a positive number', lambda value: value > 0)


def path_or(cure: str) -> Callable[[str], Path]:
    """Return a type of argument: a path that is not - (standard output elsewhere)."""
    def path(text: str) -> Path:
        if text == '-':
            raise argparse.ArgumentTypeError(f'it cannot be -: {cure}')
        return Path(text)
    return path
