# SPDX-License-Identifier: Apache-2.0
"""The arguments and the exit codes of every command."""
from __future__ import annotations

import argparse
import difflib
import math
import os
import shlex
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from dashcalib_ros.errors import DashcalibError
from dashcalib_ros.standard_streams import write_stdout

PROGRAM = 'dashcalib'
# other names of commands
ALIASES = {'calibrate': 'run'}
# exit codes
ACCEPTED = 0
WRONG = 1  # of check: the calibration does not fit the drive
BAD_INPUT = 2  # or bad usage: one line on stderr says what and the remedy
NOT_ENOUGH = 3  # weak or refused: the input was fine, the evidence was not enough
INTERRUPTED = 130  # Ctrl-C or SIGTERM, as shells have it
INPUT_HELP = ('a ROS 2 bag (folder, .mcap, .db3), a ROS 1 .bag, a video, or a folder of images; '
              'several of one camera are one drive, in this order; a folder of videos or a '
              "pattern ('clips/*.mp4') is sorted: bags by time, other files by name")
EXIT_HELP = ('exit codes: 0 accepted; 3 weak or refused (the input was fine, the evidence was '
             'not enough); 2 bad input or usage')
CALIBRATION_HELP = ('result.json (or its folder), calibration.yaml, a file of ROS, OpenCV, '
                    'Kalibr, COLMAP, of a SLAM program or a data set (docs/formats.md has all), a '
                    'JSON of fx, fy, cx, cy, k1, k2 ..., width and height, or a bag with '
                    'camera_info; FILE:NAME for one of several cameras')
SHORT_EXIT_HELP = 'exit codes: 0 done; 2 bad input or usage'
CHECK_EXIT_HELP = ('exit codes: 0 right, or differs but is good enough; 1 wrong; 3 the drive '
                   'cannot tell; 2 bad input or usage')
BATCH_EXIT_HELP = ('exit codes: 0 every clip was read and no camera was refused; 3 a clip could '
                   'not be read or a camera was refused; 2 bad manifest or usage')
# names of models, exports and demos; to take them from their tables would load OpenCV
MODELS = ('auto', 'radial', 'brown', 'fisheye')
KINDS = ('orbslam', 'vins', 'openvins', 'stella', 'svo', 'droid', 'metashape', 'matlab', 'colmap',
         'colmap-db', 'gyroflow', 'kalibr', 'opensfm', 'nerfstudio', 'mrcal', 'foxglove',
         'autoware', 'vision_pilot', 'ros', 'opencv', 'rays', 'maps', 'urdf', 'tf')
SENSOR_COLUMNS = ('time', 'gyro_x', 'gyro_y', 'gyro_z', 'speed', 'latitude', 'longitude',
                  'altitude', 'temperature')
LENSES = ('radial', 'brown', 'fisheye', 'windscreen', 'shutter', 'stabilised', 'straight')
# files that no command takes as a drive
NO_DRIVES = ('.yaml', '.yml', '.json', '.xml', '.txt', '.csv', '.npz')


def exit_code(verdict: str) -> int:
    """Return the exit code of a verdict."""
    return ACCEPTED if verdict == 'accepted' else NOT_ENOUGH


class UsageError(DashcalibError):
    """The arguments are wrong."""


def arguments_of(argv: Sequence[str]) -> list[str]:
    """Return the arguments for the parser.

    Raises UsageError for an unknown command, and for an argument without a text.
    """
    argv = [ALIASES.get(each, each) for each in argv[:1]] + list(argv[1:])
    for each in argv:
        # an empty path would be the current folder
        if each == '' or (each.startswith('--') and each.find('=') == len(each) - 1):
            raise UsageError('E-ARGUMENT-EMPTY', f'{each or "an argument"} is empty: is a shell '
                                                 f'variable not set? The current folder is .')
        if each.startswith('-out'):  # -o with a folder ut
            raise UsageError('E-ARGUMENT-UNKNOWN', f'unknown argument {each}: did you mean -o or '
                                                   f'-{each}?')
    if argv and not argv[0].startswith('-') and argv[0] not in COMMANDS:
        raise UsageError('E-COMMAND-UNKNOWN',
                         f'unknown command {argv[0]!r}: {_command_for(argv[0])}')
    # `--json -` means --json: earlier versions of run needed it
    return [each for before, each in zip(['', *argv], argv, strict=False)
            if (before, each) != ('--json', '-')]


def _command_for(word: str) -> str:
    if not word.lower().endswith(NO_DRIVES) and (
            os.path.lexists(word) or set(word) & {os.sep, '.', '*', '?'}):
        return f'did you mean `{PROGRAM} run {shlex.quote(word)}`?'
    near = difflib.get_close_matches(word, COMMANDS, 1)
    return (f'did you mean `{PROGRAM} {near[0]}`?' if near else
            f'use one of {", ".join(COMMANDS)}; see {PROGRAM} --help')


class _Lines(argparse.HelpFormatter):
    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return '\n'.join(super(_Lines, self)._fill_text(line, width, indent)
                         for line in text.split('\n'))


class Parser(argparse.ArgumentParser):
    """argparse's parser; usage errors are one line, and an unusable stdout is an error."""

    def __init__(self, **options: Any) -> None:
        super().__init__(allow_abbrev=False, formatter_class=_Lines, **options)

    def error(self, message: str) -> NoReturn:
        """Raise UsageError: one line that names --help."""
        raise UsageError('E-USAGE', f'{message}; see {self.prog} --help')

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """Parse all arguments: an unknown one must name the --help of its own command."""
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:
            near = _nearest(unknown, self._option_string_actions)
            hint = f'did you mean {", ".join(near)}? See' if near else 'see'
            raise UsageError('E-ARGUMENT-UNKNOWN', f'unknown argument {" ".join(unknown)}: '
                                                   f'{hint} {self.prog} --help')
        return found, []

    def print_help(self, file: Any = None) -> None:
        """Print the help on stdout. Raises OutputError where it cannot."""
        write_stdout(self.format_help().rstrip('\n'))


def _nearest(unknown: Iterable[str], flags: Iterable[str]) -> list[str]:
    known = list(flags)
    return [near for each in unknown if each.startswith('-')
            for near in difflib.get_close_matches(each.partition('=')[0], known, 1)]


class Version(argparse.Action):
    """--version; the version is only looked up when it is used."""

    def __init__(self, option_strings: Sequence[str], dest: str) -> None:
        super().__init__(option_strings, dest, nargs=0, help='print the version and exit')

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        """Print the version of the installed package, and the engine that estimates poses."""
        from dashcalib_ros import __version__
        from dashcalib_ros.config import ReconstructConfig
        write_stdout(f'{PROGRAM} {__version__} (poses: {ReconstructConfig().used})')
        parser.exit()


def whole_numbers(between: str, count: int, like: str) -> Callable[[str], tuple[int, ...]]:
    """Return a type of argument: `count` whole numbers, such as a size or a part of a picture."""
    def numbers(text: str) -> tuple[int, ...]:
        parts = text.lower().split(between)
        # int() refuses thousands of digits in words of its own
        if len(parts) != count or not all(
                part.strip().isdecimal() and len(part) < 20 for part in parts):
            raise argparse.ArgumentTypeError(f'{text!r} is not like {like}')
        return tuple(int(part) for part in parts)
    return numbers


def number(what: str, fits: Callable[[float], bool], parse: Callable[[str], float] = float
           ) -> Callable[[str], float]:
    """Return a type of argument: a finite number that fits. what: the range, for the message."""
    def value(text: str) -> float:
        try:
            found = parse(text)
        except ValueError:
            found = math.nan
        if not (math.isfinite(found) and fits(found)):
            raise argparse.ArgumentTypeError(f'must be {what}, not {text!r}')
        return found
    return value


def _seconds(text: str) -> float:
    """Return the seconds of 90, 1:30 or 0:01:30. Raises ValueError."""
    *first, last = text.split(':')
    seconds = float(last)
    if len(first) > 2 or not all(each.isdecimal() for each in first) or (
            first and not 0 <= seconds < 60):
        raise ValueError(text)
    return seconds + sum(60.0**place * int(each) for place, each in enumerate(reversed(first), 1))


class Celsius(float):
    """A temperature, where there may be a time, too."""


def _moment(text: str) -> float:
    return (Celsius(text.rstrip('°C')) if text.endswith('C')
            else _seconds(text.removesuffix('s')))


def path_or(remedy: str) -> Callable[[str], Path]:
    """Return a type of argument: a path that is not - (standard output elsewhere)."""
    def path(text: str) -> Path:
        if text == '-':
            raise argparse.ArgumentTypeError(f'must not be -: {remedy}')
        return Path(text)
    return path


def count(text: str) -> int:
    """Return a number of processes; a type of argument."""
    if not (text.isdecimal() and 1 <= int(text) <= 10_000):
        raise argparse.ArgumentTypeError(f'must be a whole number from 1 to 10000, not {text!r}')
    return int(text)


def _offset(text: str) -> float:
    """Return the seconds of 3600, 3600s or -1h. Raises ValueError."""
    unit = {'s': 1.0, 'h': 3600.0}.get(text[-1:], 0.0)
    return float(text[:-1]) * unit if unit else float(text)


def columns(text: str) -> dict[str, str]:
    """Return the headings of a CSV by our names; a type of argument."""
    found = dict(part.split('=', 1) for part in text.split(',') if '=' in part)
    if len(found) != text.count(',') + 1 or set(found) - set(SENSOR_COLUMNS):
        raise argparse.ArgumentTypeError(
            f'{text!r} is not like time=t_ms,gyro_x=wx,gyro_y=wy,gyro_z=wz; the names are '
            f'{", ".join(SENSOR_COLUMNS)}')
    return {'stamp_s' if name == 'time' else name: theirs for name, theirs in found.items()}


SECONDS = number('0 or more seconds, such as 90 or 1:30', lambda value: value >= 0, _seconds)
MORE_SECONDS = number('more than 0 seconds, such as 90 or 1:30', lambda value: value > 0, _seconds)
POSITIVE = number('a positive number', lambda value: value > 0)


Argument = tuple[str, dict[str, Any]]
FLAG = {'action': 'store_true'}

INPUT: Argument = ('input', {'metavar': 'INPUT', 'nargs': '+', 'help': INPUT_HELP})
CALIBRATION: Argument = ('calibration', {'metavar': 'CALIBRATION', 'type': Path,
                                         'help': CALIBRATION_HELP})
MODEL: Argument = ('--model', {
    'metavar': 'NAME', 'help': 'lens model: radial, brown, fisheye, or auto (default): the one '
                               'that the turns prove'})
SEED: Argument = ('--seed', {'type': int, 'metavar': 'S',
                             'help': 'the same input and seed give the same result'})
SETTINGS: tuple[Argument, ...] = (
    ('--config', {'type': Path, 'metavar': 'YAML', 'help': 'settings from a file'}),
    ('--set', {'action': 'append', 'default': [], 'metavar': 'KEY=VALUE',
               'help': 'one setting, over those of --config; may be repeated'}))
KNOWN: Argument = ('--known', {
    'action': 'append', 'default': [], 'metavar': 'NAME=VALUE',
    'help': 'what you know about the camera: stabiliser=no, shutter=global or 24ms, fx=1160±20, '
            'hfov=120±5, aspect=1, with a speed height=1.45±0.03 (m above the road); may be '
            'repeated'})
QUIET: Argument = ('--quiet', {
    **FLAG, 'help': 'no progress and no summary: only warnings and errors'})
NO_PROGRESS: Argument = ('--quiet', {**FLAG, 'help': 'no progress'})
VERBOSE: Argument = ('--verbose', {**FLAG, 'help': "show COLMAP's own log"})
JSON: Argument = ('--json', {**FLAG, 'help': 'print JSON on stdout, and nothing else there'})
# of the drive, behind INPUT
DRIVE: tuple[Argument, ...] = (
    ('--topic', {'metavar': 'T', 'help': "the bag's image topic"}),
    ('--stream', {'metavar': 'N', 'dest': 'topic',
                  'help': "the video's stream, where it has several: 1, 2 ..."}),
    ('--fps', {'type': POSITIVE, 'metavar': 'F',
               'help': 'images per second of a video or an image folder'}),
    ('--stamps', {'type': Path, 'metavar': 'FILE',
                  'help': "a list of the times of a folder's images: a line for each, with or "
                          'without its name'}),
    ('--start', {'type': SECONDS, 'default': 0.0, 'metavar': 'S',
                 'help': 'skip the first S seconds of the drive; 1:30 is 90'}),
    ('--duration', {'type': MORE_SECONDS, 'metavar': 'S', 'help': 'use S seconds of the drive'}),
    ('--end', {'type': MORE_SECONDS, 'metavar': 'S',
               'help': 'end S seconds after the start of the recording'}),
    ('--crop', {'type': whole_numbers(',', 4, '0,0,1280,720'), 'metavar': 'X,Y,W,H',
                'help': 'use this part of the pictures, as of two cameras side by side; the '
                        'calibration is for it, and so is the mask'}),
    ('--turns', {'type': int, 'metavar': 'N', 'help': 'use N turns'}),
    ('--thorough', {'action': 'store_true', 'default': None,
                    'help': 'use every stretch of the drive beside its turns: a smaller sigma'}),
    KNOWN,
    ('--mask', {'type': Path, 'metavar': 'PNG',
                'help': 'a picture of the size of the images; its black pixels are not used'}),
    ('--segmentation', {'metavar': 'MODEL.onnx',
                        'help': "a segmentation network that finds the camera's own car; used in "
                                'addition to the automatic mask'}),
    *SETTINGS)
# of the car's own sensors, which measure how much it turned
MOTION: tuple[Argument, ...] = (
    ('--motion', {'type': Path, 'metavar': 'FILE',
                  'help': "data of the car's own sensors: a CSV (header: stamp_s, which counts "
                          'from the first image, and any of gyro_x, gyro_y, gyro_z [rad/s], speed '
                          '[m/s], latitude, longitude, altitude), a log of Sensor Logger, '
                          'phyphox, Gyroflow (.gcsv), EuRoC or MARS logger, a GPX file, a KITTI '
                          'oxts folder, or a video that contains them'}),
    ('--columns', {'type': columns, 'metavar': 'NAME=COLUMN,...',
                   'help': 'which columns of the CSV are time, gyro_x, gyro_y, gyro_z, speed, '
                           'latitude, longitude, altitude, temperature; a heading may name its '
                           'unit (t_ms, wx [deg/s], speed_kmh)'}),
    ('--sensor-offset', {'type': number('seconds such as 0.5, 3600s or -1h', lambda _: True,
                                        _offset), 'default': 0.0, 'metavar': 'S',
                         'help': "added to the sensors' stamps, as --sensor-offset=-3600s"}),
    *((f'--{name}', {'metavar': 'TOPIC',
                     'help': f"the bag's {what} topic, if there are several"})
      for name, what in (('imu', 'Imu'), ('gps', 'NavSatFix'), ('odom', 'Odometry or Twist'))),
    ('--temperature', {'metavar': 'FILE',
                       'help': 'the temperature of the camera, which its focal length may follow: '
                               "a CSV (header: stamp_s,temperature, in °C), or a bag's topic"}),
    ('--gyro-scale-sigma', {'type': number('0 or more', lambda value: value >= 0), 'metavar': 'S',
                            'help': "relative standard deviation (sigma) of the gyro's scale; "
                                    'default: 0.03; a calibrated gyro has about 0.001'}))
# what the shell may complete: argcomplete looks for it
COMPLETED = {'--model': MODELS, '--to': KINDS}
# a command takes only one of each of these
EXCLUSIVE = (('--duration', '--end'), ('--size', '--crop'), ('--workers', '--address', '--shard'))


def out_folder(default: str, remedy: str = '') -> Argument:
    """Return --out for a folder of results."""
    return '--out', {'type': path_or(f'the results are several files, use a folder{remedy}'),
                     'default': Path(default), 'metavar': 'DIR',
                     'help': f'folder for the results (default: ./{default})'}


@dataclass(frozen=True)
class Command:
    """One command: the module that has its function, its help, and its arguments."""

    module: str
    summary: str
    description: str
    example: str
    arguments: tuple[Argument, ...]
    exit_codes: str = SHORT_EXIT_HELP


COMMANDS = {
    'run': Command(
        'dashcalib_ros.cli.run', 'calibrate a recorded drive',
        'Finds the turns of a drive, reconstructs the best ones and calibrates the camera from '
        'them. Writes result.json, report.html and, if accepted, calibration.yaml to DIR.',
        "dashcalib run 'clips/*.mp4' --out calibration", (
            INPUT, *DRIVE, *MOTION, MODEL, SEED,
            ('--workers', {'type': int, 'metavar': 'N', 'dest': 'turn_workers',
                           'help': 'processes that reconstruct turns in parallel; the result does '
                                   'not depend on it'}),
            # its earlier name
            ('--threads', {'type': int, 'dest': 'turn_workers', 'help': argparse.SUPPRESS}),
            ('--speed', {'type': POSITIVE, 'metavar': 'KMH',
                         'help': 'constant speed of the car on straight roads; from it follows '
                                 'the height of the camera'}),
            ('--no-mount', {'action': 'store_false', 'default': None, 'dest': 'mount',
                            'help': 'do not estimate how the camera is mounted on the car'}),
            ('--write-bag', {'type': Path, 'metavar': 'OUT',
                             'help': 'if accepted: write a copy of INPUT, which must be one bag, '
                                     'with a camera_info for each image'}),
            out_folder('calibration', '; --json prints result.json'),
            JSON, QUIET, VERBOSE), exit_codes=EXIT_HELP),
    'turns': Command(
        'dashcalib_ros.cli.run', 'find the turns of a drive, without calibrating',
        'Lists the turns that a calibration would choose from, best first, with their angles, '
        'and says whether they are enough.',
        'dashcalib turns drive.mp4 --start 60 --duration 300', (
            INPUT, *DRIVE, JSON, NO_PROGRESS)),
    'demo': Command(
        'dashcalib_ros.cli.demo', 'render a drive, calibrate it, compare with the truth',
        'Renders a drive with a known lens into a ROS 2 bag, calibrates it and compares the '
        'result with the truth, which is written to DIR/truth.json. A stabilised drive should be '
        'weak, and a straight one refused.',
        'dashcalib demo --lens fisheye --keep-bag --out demo', (
            ('--lens', {'choices': LENSES, 'metavar': 'KIND', 'default': LENSES[0],
                        'help': f'what is rendered: {", ".join(LENSES)} (default: {LENSES[0]})'}),
            ('--rig', {**FLAG, 'help': 'render front, left and rear instead, and place them'}),
            MODEL, SEED, out_folder('demo'),
            ('--keep-bag', {**FLAG, 'help': 'keep the bag in DIR/bag'}), JSON, QUIET, VERBOSE),
        exit_codes=EXIT_HELP),
    'compare': Command(
        'dashcalib_ros.cli.cameras', 'compare two calibrations, or two rigs',
        'Compares where both calibrations see the same rays, in pixels over the picture, after '
        'the best common rotation; whether the difference is significant, and whether it '
        'matters. Of two rigs it says which camera was moved, or exchanged with another one.',
        'dashcalib compare calibration /etc/camera/old.yaml --html compare.html', (
            ('a', {'metavar': 'A', 'type': Path, 'help': CALIBRATION_HELP}),
            ('b', {'metavar': 'B', 'type': Path,
                   'help': 'the reference: the same kinds of files'}),
            ('--html', {'type': path_or('use the name of a file'), 'metavar': 'FILE',
                        'help': 'write a page with maps of the difference, in px and in sigmas'}),
            JSON)),
    'rig': Command(
        'dashcalib_ros.cli.rig', 'calibrate several cameras of one car, and where each sits',
        'Calibrates each camera, and how it is turned against the first one, where it sits and '
        'how late its clock is: from one drive, without a board or a common view. Writes rig.json '
        'to DIR, and the result of each camera to a folder of its name.',
        'dashcalib rig front=front.mp4 left=left.mp4 rear=rear.mp4 --out rig', (
            ('cameras', {'metavar': 'NAME=INPUT', 'nargs': '+',
                         'help': f'a camera, and {INPUT_HELP}; BAG:TOPIC for one topic of a bag'}),
            ('--base', {'metavar': 'NAME',
                        'help': 'the camera that the others are placed against (default: the '
                                'first one whose lens is accepted)'}),
            ('--fps', {'type': POSITIVE, 'metavar': 'F',
                       'help': 'images per second of videos or image folders'}),
            ('--motion', {'type': Path, 'metavar': 'FILE',
                          'help': 'a speed of the car, on the clock of the base: translations are '
                                  'in metres then; files as for run'}),
            ('--match', {'action': 'store_true',
                         'help': 'use what two cameras see at the same time, too; without it that '
                                 'is a witness only'}),
            ('--known', {**KNOWN[1], 'help': 'what you know about all cameras, as for run; '
                                             'height=1.45±0.03, of the base, gives metres '
                                             'without a speed'}),
            *SETTINGS, SEED, out_folder('rig', '; --json prints rig.json'), JSON, QUIET),
        exit_codes='exit codes: 0 every camera is accepted; 3 one is weak or refused; 2 bad input '
                   'or usage'),
    'export': Command(
        'dashcalib_ros.cli.cameras', "write a calibration as another program's camera file",
        'Prints the camera in the format of another program, or writes it to FILE.',
        'dashcalib export calibration --to colmap --out cameras.txt', (
            CALIBRATION,
            ('--to', {'required': True, 'metavar': 'KIND',
                      'help': f'{", ".join(KINDS[:-1])} or {KINDS[-1]}'}),
            ('--size', {'type': whole_numbers('x', 2, '1280x720'), 'metavar': 'WxH',
                        'help': 'for pictures that were resized to this; of a CALIBRATION that '
                                'does not say the size of its pictures, that size'}),
            ('--crop', {'type': whole_numbers(',', 4, '0,100,1280,520'), 'metavar': 'X,Y,W,H',
                        'help': 'for this part of the pictures'}),
            ('--at', {'type': number('0 or more seconds, such as 12.5s or 1:30, or degrees '
                                     'Celsius such as 35C', lambda value: isinstance(
                                         value, Celsius) or value >= 0, _moment),
                      'metavar': 'S|C',
                      'help': 'of a result.json whose camera changes during the drive: the one '
                              'S seconds after the first image, or at C degrees Celsius, such '
                              'as 35C'}),
            ('--nearest', {**FLAG, 'help': 'of a lens that ROS has no model for (omni, double '
                                           'sphere, EUCM, FOV, division ...), write the nearest '
                                           'one, and say by how many px it is off'}),
            ('--out', {'type': path_or('omit --out for standard output'), 'metavar': 'FILE',
                       'help': 'default: standard output'}))),
    'check': Command(
        'dashcalib_ros.cli.check', 'tell whether a calibration explains a drive',
        'Says whether CALIBRATION is right, differs from what the drive determines but is good '
        'enough (by how many pixels, and for which uses), is wrong (in which way and by how '
        'much), or whether the drive cannot tell.',
        'dashcalib check calibration drive.mcap', (
            CALIBRATION,
            ('input', {'metavar': 'INPUT', 'nargs': '*',
                       'help': f'omit it if CALIBRATION is a bag with images; else '
                               f'{INPUT_HELP}'}),
            *DRIVE, *MOTION, MODEL, SEED,
            ('--poses', {'type': Path, 'metavar': 'FILE',
                         'help': 'true poses in the format of KITTI, TUM or EuRoC, or a GPS track '
                                 '(GPX, or a bag with NavSatFix): compare the rotation and the '
                                 'scale that each camera finds with them'}),
            ('--mount', {**FLAG, 'dest': 'mounting',
                         'help': 'a camera that was moved on the car is wrong, too'}),
            ('--out', {'type': path_or('--out must be a folder'), 'metavar': 'DIR',
                       'help': 'with --poses: write the paths as TUM files, for evo'}),
            JSON, NO_PROGRESS, VERBOSE), exit_codes=CHECK_EXIT_HELP),
    'batch': Command(
        'dashcalib_ros.cli.batch', 'calibrate many cameras from many clips',
        'Writes to DIR: a folder for each camera, tables of cameras and of clips, overview.html. '
        'If it is started again, it continues where it stopped.',
        'dashcalib batch clips.csv --out fleet', (
            ('manifest', {'metavar': 'MANIFEST',
                          'help': '.csv, .jsonl or .parquet with a column clip, and optional '
                                  'columns camera, camera_model, fps, topic, time; a folder of '
                                  'clips; or a glob in quotes'}),
            ('--out', {'required': True, 'metavar': 'DIR',
                       'help': 'a folder, or an address such as s3://bucket/fleet'}),
            ('--group-by', {'metavar': 'REGEX',
                            'help': "takes the camera from a clip's name: its first group, or "
                                    'its groups (?P<camera>...) and (?P<camera_model>...)'}),
            ('--workers', {'type': count, 'metavar': 'N',
                           'help': 'number of processes (default: one per core, as far as memory '
                                   'allows); the result does not depend on it'}),
            ('--address', {'metavar': 'A',
                           'help': 'address of a Ray cluster; auto: the one on this machine'}),
            ('--shard', {'metavar': 'I/N',
                         'help': 'process part I of N, in one process; afterwards a run without '
                                 '--shard writes the tables'}),
            *SETTINGS, MODEL, SEED, JSON, QUIET), exit_codes=BATCH_EXIT_HELP)}


def make_parser() -> Parser:
    """Return the parser; the parsed arguments have the command's name as `command`."""
    parser = Parser(
        prog=PROGRAM, epilog=f'{PROGRAM} COMMAND --help explains a command\n{EXIT_HELP}',
        description='Calibrates a dashcam from the turns that the car takes.')
    parser.add_argument('-V', '--version', action=Version)
    commands = parser.add_subparsers(dest='command', metavar='COMMAND', required=True,
                                     parser_class=Parser)
    for name, command in COMMANDS.items():
        own = commands.add_parser(
            name, help=command.summary, description=command.description,
            epilog=f'example: {command.example}\n{command.exit_codes}')
        there = {flag for flag, _ in command.arguments}
        alone = {flag: group for flags in EXCLUSIVE if there >= set(flags)
                 for group in [own.add_mutually_exclusive_group()] for flag in flags}
        for flag, options in command.arguments:
            names = ('-o', flag) if flag == '--out' else (flag,)
            action = alone.get(flag, own).add_argument(*names, **options)
            if flag in COMPLETED:
                action.completer = lambda n=COMPLETED[flag], **_: n  # type: ignore[attr-defined]
    return parser
