# SPDX-License-Identifier: Apache-2.0
"""The command as a user meets it: help, usage, missing input, compare, streams.

In a process of its own where that is what matters; elsewhere here, which takes no second to start.
"""
from __future__ import annotations

import dataclasses
import json
import os
import re
import shutil
import subprocess
import sys
import unicodedata
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from fakes import called_like
from made_calibration import MOUNT, TRUTH, make_calibration

import dashcalib_ros
from dashcalib_ros.camera import AUTO, calibrated_models
from dashcalib_ros.camera.field import TERMS as FIELD_TERMS
from dashcalib_ros.cli import main
from dashcalib_ros.cli import rig as rig_command
from dashcalib_ros.cli.arguments import (
    COMMANDS,
    JSON,
    KINDS,
    LENSES,
    MODELS,
    UsageError,
    arguments_of,
    make_parser,
)
from dashcalib_ros.cli.terminal import show, warn
from dashcalib_ros.config import Config
from dashcalib_ros.demo import DEMOS
from dashcalib_ros.errors import Notice
from dashcalib_ros.formats.export import EXPORTS
from dashcalib_ros.formats.rig import rig_json
from dashcalib_ros.report import write_results
from dashcalib_ros.report.tables import line
from dashcalib_ros.rig.placed import PlacedCamera, RigCalibration, base_camera
from dashcalib_ros.rig_session import Rig, open_camera, rig_of_drives
from dashcalib_ros.workers.worker import THREAD_VARIABLES

HEAVY = ('numpy', 'cv2', 'scipy', 'yaml', 'rich', 'matplotlib', 'pycolmap', 'rosbags', 'rclpy')


def dashcalib(*args, env=None):
    return subprocess.run([sys.executable, '-m', 'dashcalib_ros', *map(str, args)],
                          capture_output=True, text=True, env=env, timeout=120)


@pytest.fixture
def here(capfd):
    """Run the command in this process."""
    def run(*args):
        code = main([*map(str, args)])
        return subprocess.CompletedProcess(args, code, *capfd.readouterr())
    return run


def assert_one_line_error(done, code=''):
    """Check that a command ended with one line of an error; code: in brackets at its end."""
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith('dashcalib: error: '), done.stderr
    assert not code or done.stderr.endswith(f' [{code}]\n'), done.stderr
    assert done.stderr.count('\n') == 1, done.stderr
    assert done.stdout == ''


@pytest.fixture
def results(tmp_path):
    """Make a folder with an accepted result and a truth."""
    write_results(make_calibration(), tmp_path / 'a')
    (tmp_path / 'truth.json').write_text(json.dumps(
        {**dataclasses.asdict(TRUTH), 'fx': TRUTH.fx - 7, 'width': 1242, 'height': 375}))
    return tmp_path


@pytest.mark.parametrize('command', [[], ['run'], ['turns'], ['demo'], ['compare'],
                                     ['export']])
def test_help_names_the_exit_codes(here, command):
    done = here(*command, '--help')
    assert (done.returncode, done.stderr) == (0, '')
    assert done.stdout.startswith('usage: dashcalib')
    text = ' '.join(done.stdout.split())
    # only these end with a verdict
    assert ('3 weak or refused' in text) == (command in ([], ['run'], ['demo']))
    assert 'exit codes: 0 ' in text and '2 bad input or usage' in text
    assert f'example: dashcalib {command[0]} ' in text if command else 'COMMAND --help' in text
    assert max(map(len, done.stdout.splitlines())) <= 80


def test_an_unknown_argument_names_the_help_of_its_command(here):
    done = here('demo', 'extra')
    assert_one_line_error(done, 'E-ARGUMENT-UNKNOWN')
    assert 'extra' in done.stderr and 'dashcalib demo --help' in done.stderr


@pytest.mark.parametrize(('args', 'code', 'hint'), [
    (['drive.mp4'], 'E-COMMAND-UNKNOWN', '`dashcalib run drive.mp4`'),
    (['clips/*.mp4', '--fps', '10'], 'E-COMMAND-UNKNOWN', "`dashcalib run 'clips/*.mp4'`"),
    (['drives'], 'E-COMMAND-UNKNOWN', '`dashcalib run drives`'),
    (['rnu', 'x'], 'E-COMMAND-UNKNOWN', '`dashcalib run`'),
    (['exprot'], 'E-COMMAND-UNKNOWN', '`dashcalib export`'),
    # no drive, and like no command
    (['camera.yaml'], 'E-COMMAND-UNKNOWN', 'run, turns, demo, compare, rig, export, check, batch'),
    (['run', 'x', '--fsp', '10'], 'E-ARGUMENT-UNKNOWN', 'did you mean --fps?'),
    (['run', 'x', '--worker=2'], 'E-ARGUMENT-UNKNOWN', 'did you mean --workers?'),
    (['run', 'x', '-fps', '2'], 'E-ARGUMENT-UNKNOWN', 'did you mean --fps?'),
    (['run', 'x', '-out', 'y'], 'E-ARGUMENT-UNKNOWN', 'did you mean -o or --out?'),
    (['run', ''], 'E-ARGUMENT-EMPTY', 'empty'), (['check', '', 'x'], 'E-ARGUMENT-EMPTY', ''),
    (['run', 'x', '--out='], 'E-ARGUMENT-EMPTY', '--out='),
    (['batch', 'x', '--out', ''], 'E-ARGUMENT-EMPTY', ''),
    (['run', 'x', '--start', '20', '--end', '0:10'], 'E-INPUT-DURATION', '20'),
    (['compare', 'a', 'b', '--qqqq'], 'E-ARGUMENT-UNKNOWN', 'dashcalib compare --help')])
def test_a_slip_gets_the_nearest_name(here, tmp_path, monkeypatch, args, code, hint):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'drives').mkdir()
    done = here(*args)
    assert_one_line_error(done, code)
    assert hint in done.stderr


@pytest.mark.parametrize(('text', 'seconds'), [
    ('90', 90.0), ('1:30', 90.0), ('0:01:30.5', 90.5), ('2:00:00', 7200.0), ('1e2', 100.0),
    *((text, None) for text in ('1:60', '1:-3', ':30', '1:', '1:2:3:4', 'x', '1:x', '-1', 'inf',
                                '1:nan'))])
def test_times_may_have_minutes(text, seconds):
    parser = make_parser()
    if seconds is None:
        with pytest.raises(UsageError):
            parser.parse_args(['run', 'x', f'--start={text}'])
        return
    args = parser.parse_args(['run', 'x', '--start', text, '-o', 'there'])
    assert (args.start, str(args.out)) == (seconds, 'there')


def test_another_name_of_run():
    assert arguments_of(['calibrate', 'x']) == ['run', 'x']
    assert arguments_of(['run', 'calibrate']) == ['run', 'calibrate']


def test_json_is_the_same_flag_of_each_command():
    flags = {name: [argument for argument in command.arguments if argument[0] == '--json']
             for name, command in COMMANDS.items()}
    # what export prints is a file already
    assert flags.pop('export') == [] and all(found == [JSON] for found in flags.values())


def test_the_names_that_help_has_are_those_of_the_tables():
    assert tuple(DEMOS) == LENSES and tuple(EXPORTS) == KINDS
    assert (AUTO, *(model.model for model in calibrated_models())) == MODELS


@pytest.mark.parametrize('kind', KINDS)
def test_documents_name_every_kind_of_export(kind):
    docs = Path(__file__).parents[2] / 'docs'
    [line] = re.findall(r'^dashcalib export calibration --to (opencv .*)$',
                        (docs / 'usage.md').read_text(), re.MULTILINE)
    assert re.search(rf'\b{kind}\b', line)
    exports = (docs / 'formats.md').read_text().partition('### Exports')[2].partition('\n### ')[0]
    assert f'`{kind}`' in exports


def test_an_earlier_name_of_a_setting_is_a_warning_of_one_line():
    done = dashcalib('turns', 'nothing', '--set', 'threads=1')
    assert done.stderr.splitlines()[0] == (
        'dashcalib: warning: the setting threads is called workers now'), done.stderr
    assert done.stderr.count('\n') == 2


def test_help_imports_nothing_heavy():
    code = ('import sys; from dashcalib_ros.cli import main; before = main(["run", "--help"]); '
            f'print(before, [name for name in {HEAVY} if name in sys.modules])')
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == '0 []', done.stdout + done.stderr


@pytest.mark.parametrize(('asked', 'threads'), [(None, '1'), ('2', '2')])
@pytest.mark.parametrize(('of', 'call'), [
    ('cli', 'main(["--help"])'), ('ros', 'main("calibrator", ["--help"])')], ids=['cli', 'ros'])
def test_numpy_gets_one_thread_unless_more_are_asked_for(of, call, asked, threads):
    if of == 'ros':
        pytest.importorskip('rclpy')
    code = (f'import os, sys; from dashcalib_ros.{of} import main; before = "numpy" in '
            f'sys.modules; {call}; print(before, os.environ["OPENBLAS_NUM_THREADS"])')
    env = {name: text for name, text in os.environ.items() if name not in THREAD_VARIABLES}
    env |= {} if asked is None else {'OPENBLAS_NUM_THREADS': asked}
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, env=env)
    assert done.stdout.splitlines()[-1] == f'False {threads}', done.stdout + done.stderr


@pytest.mark.parametrize(('line', 'expected'), [
    ('dashcalib ', ['run', 'turns', 'demo', 'compare', 'rig', 'export', 'check',
                    'batch']),
    ('dashcalib run --mod', ['--model']), ('dashcalib export x --to n', ['nerfstudio']),
    ('dashcalib demo --model f', ['fisheye'])])
def test_the_shell_completes(tmp_path, line, expected):
    pytest.importorskip('argcomplete')
    out = tmp_path / 'completions'
    done = dashcalib(env={**os.environ, '_ARGCOMPLETE': '1', 'COMP_LINE': line,
                          'COMP_POINT': str(len(line)), '_ARGCOMPLETE_IFS': '\n',
                          '_ARGCOMPLETE_STDOUT_FILENAME': str(out)})
    assert done.stdout == ''
    found = [each.strip() for each in out.read_text().splitlines()]
    assert [each for each in found if not each.startswith('-') or len(found) == 1] == expected


def test_version():
    done = dashcalib('--version')
    assert (done.returncode, done.stdout) == (
        0, f'dashcalib {dashcalib_ros.__version__} (poses: {Config().reconstruct.used})\n')
    assert dashcalib('-V').stdout == done.stdout


@pytest.mark.parametrize(('args', 'complaint'), [
    ([], 'COMMAND'),
    (['run'], 'INPUT'),
    (['run', 'x', '--fps', '0'], 'positive number'),
    (['run', 'x', '--fps', 'nan'], 'positive number'),
    (['run', 'x', '--turns', 'many'], '--turns'),
    (['run', 'x', '--out', '-'], '--json'),
    (['run', 'x', '--start', '-1'], '0 or more seconds'),
    (['turns', 'x', '--duration', '0'], 'more than 0 seconds'),
    (['demo', '--out', '-'], '--out'),
    (['demo', '--lens', 'fishy'], 'windscreen'),
    (['export', 'a', '--to', 'ros', '--out', '-'], '--out'),
    (['compare', 'a'], 'B'),
    (['export', 'a'], '--to'),
    (['export', 'a', '--to', 'ros', '--size', '640'], '1280x720'),
    (['export', 'a', '--to', 'ros', '--at', 'noon'], '12.5s'),
    (['export', 'a', '--to', 'ros', '--crop', '0,0,x,9'], '0,100,1280,520'),
    (['export', 'a', '--to', 'ros', '--crop', '0,0,9,9', '--size', '9x9'], 'not allowed'),
])
def test_bad_usage_is_one_line(here, args, complaint):
    done = here(*args)
    assert_one_line_error(done, 'E-USAGE')
    assert complaint in done.stderr and '--help' in done.stderr


def test_compare_shows_the_difference(results):
    done = dashcalib('compare', results / 'a', results / 'truth.json')
    assert (done.returncode, done.stderr) == (0, '')
    assert re.search(r'fx +721.54 px +714.54 px +\+7.0000 +\+0.980 % +2.0\n', done.stdout)
    # without a covariance, pixels decide
    assert 'answer: differs' in done.stdout and 'good enough for detection' in done.stdout
    assert '\x1b' not in done.stdout


def test_compare_as_json(here, results):
    done = here('compare', results / 'a/calibration.yaml', results / 'truth.json', '--json')
    assert (done.returncode, done.stderr) == (0, '')
    data = json.loads(done.stdout)
    assert data['parameters']['fx']['difference'] == pytest.approx(7)
    assert data['parameters']['fx']['z'] == pytest.approx(2)
    assert 0 < data['mapping_px'] < 7
    assert data['a']['verdict'] == 'accepted'


def test_two_rigs_of_one_car(here, tmp_path):
    rig = RigCalibration('front', {'front': base_camera('front/result.json'), 'rear': PlacedCamera(
        'rear/result.json', 'accepted', (2.0, 177.5, 1.5), (0.05, 0.05, 0.05))})
    turned = replace(rig.cameras['rear'], rotation_deg=(2.0, 176.0, 1.5))
    for name, each in (('a', rig), ('b', replace(rig, cameras={**rig.cameras, 'rear': turned}))):
        (tmp_path / name).mkdir()
        (tmp_path / name / 'rig.json').write_text(rig_json(each))
    old = shutil.copy(tmp_path / 'a/rig.json', tmp_path / 'old.json')
    told = here('compare', tmp_path / 'b', old)
    assert (told.returncode, told.stderr) == (0, '') and 'answer: wrong' in told.stdout
    data = json.loads(here('compare', tmp_path / 'b', old, '--json').stdout)
    assert data['answer'] == 'wrong' and data['cameras']['rear']['perhaps'] is True
    assert abs(data['cameras']['rear']['rotation_deg'][1]) == pytest.approx(1.5, abs=0.1)
    assert json.loads(here('compare', tmp_path / 'a', old, '--json').stdout)['answer'] == 'right'
    camera = tmp_path / 'camera.json'
    camera.write_text('{"fx": 700, "fy": 700, "cx": 320, "cy": 240, "width": 640, "height": 480}')
    for code, *args in (('E-RIG-FILE', camera), ('E-RIG-HTML', old, '--html', camera)):
        refused = here('compare', tmp_path / 'a', *args)
        assert_one_line_error(refused)
        assert f'[{code}]' in refused.stderr


def test_a_rig_is_asked_for_by_names(here, tmp_path, monkeypatch):
    for code, *args in (('E-RIG-ARGUMENT', 'front.mp4', 'rear=rear.mp4'),
                        ('E-RIG-ARGUMENT', 'front=', 'rear=rear.mp4'),
                        ('E-RIG-NAME-TWICE', 'a=front.mp4', 'a=rear.mp4')):
        assert_one_line_error(here('rig', *args), code)
    found = RigCalibration('rear', {name: PlacedCamera(f'{name}/result.json', 'accepted', zero,
                                                       (0.05, 0.05, 0.05))
                                    for name, zero in (('front', (0.0, 180.0, 0.0)),
                                                       ('rear', (0.0, 0.0, 0.0)))})
    asked, opened = [], {}

    @called_like(rig_of_drives)
    def solved(drives, base=None, config=None, observer=None, place=None, match=False):
        asked.append((list(drives), base, match))
        return Rig(found, {name: make_calibration() for name in drives})

    @called_like(open_camera)
    def open_one(path, fps=None, motion=None):
        opened[path] = fps, motion

    monkeypatch.setattr(rig_command, 'rig_of_drives', solved)
    monkeypatch.setattr(rig_command, 'open_camera', open_one)
    cameras = ('front=front.mp4', 'rear=d.mcap:/rear')
    for more, expected in (((), (None, False)), (('--base', 'rear', '--match'), ('rear', True))):
        done = here('rig', *cameras, '--out', tmp_path / 'rig', '--motion', 'm.csv', *more)
        assert done.returncode == 0, done.stderr
        assert asked[-1] == (['front', 'rear'], *expected)
        # of the first camera's clock, or the base's
        assert opened == {'front.mp4': (None, None if more else Path('m.csv')),
                          'd.mcap:/rear': (None, Path('m.csv') if more else None)}
    assert (tmp_path / 'rig' / 'rig.json').exists()


def test_mountings_are_exported(here, results):
    for name, mount in (('front', MOUNT), ('rear', replace(MOUNT, yaw_left_deg=179.0))):
        turn = replace(make_calibration().turns[0], right_deg=88.0)
        write_results(make_calibration(mount=mount, turns=(turn,)), results / name)
        urdf = here('export', results / name, '--to', 'urdf', '--out', results / f'{name}.urdf')
        assert (urdf.returncode, urdf.stdout, urdf.stderr) == (0, '', '')
    refused = here('export', results / 'a', '--to', 'urdf')
    assert_one_line_error(refused)
    assert '[E-EXPORT-NO-MOUNTING]' in refused.stderr
    weak = replace(MOUNT, verdict='weak', reasons=(Notice('E-MOUNT-LENS', 'so'),))
    write_results(make_calibration(mount=weak), results / 'weak')
    warned = here('export', results / 'weak', '--to', 'tf')
    assert warned.returncode == 0 and 'weak_optical_frame' in warned.stdout
    assert warned.stderr.endswith(' weak (so) [E-EXPORT-MOUNT-WEAK]\n')


def test_export_prints_or_writes_a_camera_file(here, results):
    printed = here('export', results / 'a', '--to', 'colmap')
    assert (printed.returncode, printed.stderr) == (0, '')
    assert re.search(r'^1 OPENCV 1242 375 721\.', printed.stdout, re.MULTILINE)
    out = results / 'cameras.txt'
    written = here('export', results / 'a', '--to', 'colmap', '--out', out)
    assert (written.returncode, written.stdout, written.stderr) == (0, '', '')
    assert out.read_text() == printed.stdout
    write_results(make_calibration('weak'), results / 'weak')
    weak = here('export', results / 'weak', '--to', 'colmap')
    assert (weak.returncode, weak.stdout) == (0, printed.stdout)
    assert weak.stderr.endswith(' [E-EXPORT-WEAK]\n') and weak.stderr.count('\n') == 1
    half = here('export', results / 'a', '--to', 'ros', '--size', '621x188')
    assert half.returncode == 0 and 'image_width: 621' in half.stdout
    # an .npz is not for a terminal
    rays = here('export', results / 'a', '--to', 'rays', '--size', '414x125')
    assert_one_line_error(rays)
    assert '--out rays.npz' in rays.stderr and '[E-OUT-NEEDED]' in rays.stderr
    picture = results / 'm.png'
    maps = here('export', results / 'a', '--to', 'maps', '--out', picture)
    assert_one_line_error(maps)
    assert '[E-EXPORT-SUFFIX]' in maps.stderr and 'm.npz' in maps.stderr
    assert not picture.exists()
    here('export', results / 'a', '--to', 'rays', '--out', results / 'rays.npz')
    assert here('compare', results / 'a', results / 'rays.npz').returncode == 0


def test_export_tells_where_the_field_over_the_picture_goes(here, results, tmp_path):
    data = json.loads((results / 'a/result.json').read_text())
    coefficients = np.zeros((2, len(FIELD_TERMS)))
    # 0.3 px everywhere to the right, and 0.4 px down
    coefficients[:, 0] = 0.3, 0.4
    data['field'] = {'used': True, 'coefficients': coefficients.tolist()}
    path = tmp_path / 'result.json'
    path.write_text(json.dumps(data))
    splined = here('export', path, '--to', 'mrcal')
    assert (splined.returncode, splined.stderr) == (0, '')
    assert 'LENSMODEL_SPLINED_STEREOGRAPHIC_order=3' in splined.stdout
    without = here('export', path, '--to', 'ros')
    assert without.returncode == 0
    assert without.stderr.count('0.50 px') == 2
    assert without.stderr.endswith(' [E-EXPORT-FIELD-LOST]\n')
    part = here('export', path, '--to', 'mrcal', '--crop', '0,0,640,375')
    assert_one_line_error(part)
    assert '[E-FIELD-OF-PART]' in part.stderr


def test_export_writes_the_camera_of_a_time(here, results, tmp_path):
    data = json.loads((results / 'a/result.json').read_text())
    given, path = data['intrinsics'], tmp_path / 'result.json'
    data['intrinsics_at'] = [
        {'time_s': time_s, 'intrinsics': {**given, 'fx': times * given['fx']},
         'sigma': data['sigma']} for time_s, times in ((10.0, 1.0), (20.0, 1.02))]
    path.write_text(json.dumps(data))
    written = here('export', path, '--to', 'nerfstudio', '--at', '12.5s')
    assert written.returncode == 0
    assert json.loads(written.stdout)['fl_x'] == pytest.approx(1.005 * given['fx'])
    refused = here('export', path, '--to', 'nerfstudio', '--at', '35C')
    assert_one_line_error(refused)
    assert '[E-NO-TEMPERATURE]' in refused.stderr
    data |= {'temperature_c': 30.0, 'drift': {
        'fx_percent_per_hour': 0.1, 'sigma': 0.1, 'from_first_to_last_percent': 0.1,
        'fx_percent_per_kelvin': 0.05, 'sigma_per_kelvin': 0.01, 'from_c': -5.0, 'to_c': 40.0}}
    path.write_text(json.dumps(data))
    for at, times in (('38°C', 1.004), ('-2C', 0.984)):
        written = here('export', path, '--to', 'nerfstudio', f'--at={at}')
        assert json.loads(written.stdout)['fl_x'] == pytest.approx(times * given['fx'])


def test_a_lens_profile_has_the_readout_time_of_its_rows(here, results, tmp_path):
    data = json.loads((results / 'a/result.json').read_text())
    data['rolling_shutter'] = {'readout_ms': 20.0, 'sigma_ms': 0.3}
    path = tmp_path / 'result.json'
    path.write_text(json.dumps(data))
    for more, wanted_ms in (((), 20.0), (('--size', '621x188'), 20.0),
                            (('--crop', '0,0,1242,300'), 16.0)):
        done = here('export', path, '--to', 'gyroflow', *more)
        assert (done.returncode, done.stderr) == (0, '')
        assert json.loads(done.stdout)['frame_readout_time'] == pytest.approx(wanted_ms)
    without = here('export', results / 'a', '--to', 'gyroflow')
    assert without.returncode == 0 and json.loads(without.stdout)['frame_readout_time'] is None
    assert without.stderr.endswith(' [E-EXPORT-NO-READOUT]\n')


def test_export_to_what_there_is_not(here, results):
    done = here('export', results / 'a', '--to', 'blender')
    assert_one_line_error(done)
    assert ', '.join(EXPORTS) in done.stderr
    assert_one_line_error(here('export', results / 'missing', '--to', 'ros'))


@pytest.mark.parametrize('content', [None, b'', b'\x89junk\x00\xff', b'{}', b'fx: 3', b'[[['])
def test_compare_with_what_is_no_calibration(here, results, content):
    if content is not None:
        (results / 'b').write_bytes(content)
    assert_one_line_error(here('compare', results / 'a', results / 'b'))


def test_output_that_is_no_longer_read_is_no_error(results):
    reader, writer = os.pipe()
    os.close(reader)
    try:
        done = subprocess.run(
            [sys.executable, '-m', 'dashcalib_ros', 'compare', results / 'a',
             results / 'truth.json', '--json'], stdout=writer, stderr=subprocess.PIPE, text=True)
    finally:
        os.close(writer)
    assert (done.returncode, done.stderr) == (0, '')


def test_a_terminal_that_knows_ascii_only_still_gets_the_numbers(results):
    done = dashcalib('compare', results / 'a', results / 'truth.json',
                     env={**os.environ, 'PYTHONIOENCODING': 'ascii'})
    assert done.returncode == 0 and '721.54 px' in done.stdout


# -- standard streams that take nothing --------------------------------------------------------

CLOSED, FULL = 'E-STDOUT-CLOSED', 'E-STDOUT-UNWRITABLE'


def redirected(redirection, *args):
    """Run the command behind a redirection of the shell."""
    return subprocess.run(
        ['sh', '-c', f'exec "$@" {redirection}', 'sh', sys.executable, '-m', 'dashcalib_ros',
         *map(str, args)], capture_output=True, text=True, timeout=120)


@pytest.fixture
def commands(results):
    """Return each command whose whole result is what it prints."""
    (results / 'drive').mkdir()
    for index in range(4):
        cv2.imwrite(str(results / 'drive' / f'{index}.png'), np.full((48, 64), 60, np.uint8))
    drive = (results / 'drive', '--fps', 10)
    return {'help': ['--help'], 'version': ['--version'],
            'compare': ['compare', results / 'a', results / 'truth.json'],
            'turns': ['turns', *drive], 'run': ['run', *drive, '--out', results / 'out'],
            'error': ['compare', results / 'a', results / 'missing']}


@pytest.mark.parametrize(('redirection', 'code'), [('>&-', CLOSED), ('>/dev/full', FULL)])
@pytest.mark.parametrize('name', ['help', 'version', 'compare', 'turns'])
def test_a_result_that_cannot_be_shown_is_one_line(commands, name, redirection, code):
    assert_one_line_error(redirected(redirection, *commands[name]), code)


@pytest.mark.parametrize(('redirection', 'word'), [
    ('>&-', 'closed'), ('>/dev/full', 'No space left on device')])
def test_a_run_whose_files_are_written_ends_with_its_verdict(commands, results, redirection,
                                                             word):
    done = redirected(redirection, *commands['run'])
    assert done.returncode == 3 and done.stderr.startswith('dashcalib: warning: ')
    assert word in done.stderr and done.stderr.count('\n') == 1
    assert json.loads((results / 'out' / 'result.json').read_text())['verdict'] == 'refused'


@pytest.mark.parametrize('redirection', ['2>&-', '2>/dev/full'])
@pytest.mark.parametrize(('name', 'code'), [
    ('help', 0), ('version', 0), ('compare', 0), ('turns', 0), ('run', 3), ('error', 2)])
def test_without_stderr_the_outcome_is_the_same(here, commands, name, code, redirection):
    done = redirected(redirection, *commands[name])
    assert (done.returncode, done.stderr) == (code, '')
    assert name == 'run' or done.stdout == here(*commands[name]).stdout
    assert 'dashcalib: error' not in done.stdout


@pytest.mark.parametrize(('name', 'code'), [
    ('help', 2), ('version', 2), ('compare', 2), ('turns', 2), ('run', 3), ('error', 2)])
@pytest.mark.parametrize('redirection', ['>&- 2>&-', '<&- >&- 2>&-'])
def test_without_any_stream_the_exit_code_tells(commands, name, code, redirection):
    assert redirected(redirection, *commands[name]).returncode == code


def test_bad_usage_without_stderr_prints_nothing_on_stdout():
    done = redirected('2>&-', 'run')
    assert (done.returncode, done.stdout) == (2, '')


def test_a_file_does_not_become_stdout(results):
    """The first file that is opened would get the number of a stream that is closed."""
    code = ('import os; from dashcalib_ros.standard_streams import open_closed_streams as f; f(); '
            'open("file", "w").fileno(); os.write(1, b"native"); os.write(2, b"native")')
    subprocess.run(['sh', '-c', 'exec "$@" <&- >&- 2>&-', 'sh', sys.executable, '-c', code],
                   cwd=results, check=True)
    assert (results / 'file').read_bytes() == b''


def test_an_interrupt_while_a_module_is_imported_has_its_own_exit_code(tmp_path):
    # dataclasses make their methods by exec() of a text; Python remembers an interrupt from there
    (tmp_path / 'interrupting.py').write_text('exec("raise KeyboardInterrupt")')
    (tmp_path / 'interrupted.py').write_text(
        'import dataclasses, sys\n'
        'from dashcalib_ros.cli import program\n'
        'demo = dataclasses.replace(program.COMMANDS["demo"], module="interrupting")\n'
        'program.COMMANDS["demo"] = demo\n'
        'sys.exit(program.main(["demo"]))\n')
    done = subprocess.run([sys.executable, '-m', 'interrupted'], cwd=tmp_path, timeout=60,
                          capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (130, 'dashcalib: error: interrupted\n')


# clears a screen, sets its title, turns the direction of writing, and forges a line
FORGED = 'a\x1b[2J\x1b]0;b\x07\x9b1m\u202eb\u2066\u2028\x85\nverdict: accepted'


def acts(text):
    return [sign for sign in text if sign != '\n' and (
        unicodedata.category(sign) in ('Cc', 'Zl', 'Zp')
        or unicodedata.bidirectional(sign) in ('RLO', 'LRI'))]


@pytest.mark.parametrize('terminal', [False, True])
def test_names_cannot_act_on_a_terminal(results, tmp_path, capsys, monkeypatch, terminal):
    assert len(acts(FORGED)) == 8
    monkeypatch.chdir(tmp_path)
    shutil.copytree(results / 'a', FORGED)
    main(['compare', FORGED, FORGED])
    main(['compare', f'{FORGED}/gone', FORGED])
    warn([Notice('E-ODD', f'{FORGED} is odd')])
    monkeypatch.setattr(sys.stdout, 'isatty', lambda: terminal)
    show(line(FORGED))
    said = ''.join(capsys.readouterr())
    # a name's own line ends, too
    assert not acts(said) and '\nverdict' not in said and said.count(r'\x1b[2J') >= 4


def test_native_libraries_say_nothing_on_stderr(tmp_path):
    whole = cv2.imencode('.jpg', np.random.default_rng(0).integers(
        256, size=(240, 320), dtype=np.uint8))[1].tobytes()
    for n in range(12):
        spoiled = bytearray(whole)
        spoiled[2000 + n] ^= 255
        (tmp_path / f'{n}.jpg').write_bytes(spoiled)
    done = dashcalib('turns', tmp_path, '--fps', '10')
    assert done.returncode == 0
    assert all(each.startswith('dashcalib: ') for each in done.stderr.splitlines()), done.stderr


def test_export_tells_of_a_lens_that_folds_over_inside_the_picture(here, tmp_path):
    text = ('{"K": [[1870, 0, 647.5], [0, 1880, 485.5], [0, 0, 1]], "image_size": [1296, 972], '
            '"dist": %s}')
    path = tmp_path / 'camera.json'
    path.write_text(text % '[-13.2, -98.0, 0.0014, 0.0028, 1357.8, -13.05, -102.4, 1383.0]')
    done = here('export', path, '--to', 'ros')
    assert done.returncode == 0 and done.stderr.strip().endswith('[E-CALIBRATION-FOLDS]')
    path.write_text(text % '[-0.3, 0.1, 0, 0, 0]')
    assert here('export', path, '--to', 'ros').stderr == ''
