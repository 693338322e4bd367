# SPDX-License-Identifier: Apache-2.0
"""Every command and every piece of Python in the documents is run here, on small inputs.

What cannot be run on any machine that tests this stands in CANNOT_RUN, with the reason.
"""
from __future__ import annotations

import re
import shlex
import shutil
import signal
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from made_calibration import calibration_of
from made_drives import (
    START,
    drive,
    images,
    info_of,
    smooth,
    write_bag,
    write_folder,
    write_ros1,
    write_video,
)
from waiting import wait_for

from dashcalib_ros.camera import Radial
from dashcalib_ros.cli import main
from dashcalib_ros.cli.arguments import make_parser
from dashcalib_ros.pipeline import Calibrator
from dashcalib_ros.report import write_results

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', *sorted((ROOT / 'docs').glob('*.md')),
             *sorted((ROOT / 'benchmark').rglob('*.md'))]
# how a command begins, and why it is not run here
CANNOT_RUN = {
    'sudo apt': "installs the distribution's packages",
    'source': "needs apt's ROS, or an environment that was just made",
    '.': 'needs an environment that was just made',
    'git clone': 'copies into the home folder',
    'cd': 'moves about a workspace that was just made',
    'mkdir': 'makes a workspace for colcon',
    'python3 -m venv': "makes an environment: .ci/run does, with the README's own command",
    'pip install': "installs: .ci/run does, with the README's own command",
    'python -m pytest': 'is what runs this test',
    'python -m colcon': 'test/ros/test_install.py builds with colcon, where it is',
    'colcon': 'test/ros/test_install.py builds with colcon, where it is',
    'pre-commit': "changes the clone's hooks",
    'docker': 'no container engine: test_packaging.py checks the Dockerfile as far as it can',
    'ros2 launch': 'not on the package index; test/ros/test_install.py checks the launch files',
    'ros2': "needs apt's ROS: the package index has no ros2 command",
    'rviz2': "needs apt's ROS",
    'ROS_SECURITY_ENABLE=true': 'needs keys that ros2 security makes',
    'jupyter execute': 'takes a minute, and writes into examples/',
    'python examples/play.py': 'test/ros/test_play.py plays a video to a node',
    'python benchmark/': 'takes minutes to hours: test_benchmark.py starts each with --help',
    'python -m benchmark': 'takes up to a day: test_benchmark.py runs a part that is made up',
    'benchmark/': 'takes half an hour: it emulates another processor',
    'dashcalib batch s3://': 'needs a bucket and a cluster: test/fleet has both in memory',
    'dashcalib demo': 'takes a minute: test/cli/test_run.py runs it with two turns',
}
SIZE = (1280, 720)
CAMERA = Radial(SIZE, 800.0, 802.0, 645.0, 352.0, -0.3, 0.1)
# the verdict on the short drives here is refused
CODES = {'run': {3}, 'check': {3}, 'batch': {0, 3}}


@dataclass(frozen=True)
class Block:
    """A fenced block: where it stands, its language and its lines."""

    place: str
    language: str
    text: str


def blocks_of(text, name):
    """Return the fenced blocks of a document."""
    found = re.finditer(r'^```(\w+)\n(.*?)^```$', text, re.MULTILINE | re.DOTALL)
    return [Block(f'{name}:{text[:each.start()].count(chr(10)) + 2}', each[1], each[2])
            for each in found]


def commands_of(block):
    """Return the simple commands of a block of bash, as lists of words."""
    found = []
    for line in block.text.replace('\\\n', ' ').splitlines():
        # a bracket or brace is no operator here
        lexer = shlex.shlex(line, posix=True, punctuation_chars='&|;<>')
        lexer.whitespace_split, lexer.commenters = True, '#'
        words = []
        for word in lexer:
            if set(word) <= set('&|;'):
                found.append(words)
                words = []
            else:
                words.append(word)
        found.append(words)
    return [words for words in found if words]


BLOCKS = [block for path in DOCUMENTS for block in blocks_of(
    path.read_text(), str(path.relative_to(ROOT)))]
COMMANDS = [pytest.param(words, id=f'{block.place} {" ".join(words)}'[:90]) for block in BLOCKS
            if block.language == 'bash' for words in commands_of(block)]
PYTHON = [pytest.param(block.text, id=block.place) for block in BLOCKS
          if block.language == 'python']


def bare(words):
    """Return a command without what only says where it writes."""
    return words[:words.index('>')] if '>' in words else words


def reason(words):
    """Return why a command cannot be run; None if it can, or is not known."""
    text = ' '.join(bare(words)) + ' '
    begins = [key for key in CANNOT_RUN if text.startswith(key if key[-1] == '/' else f'{key} ')]
    return CANNOT_RUN[max(begins, key=len)] if begins else None


def node_arguments(words):
    """Return the program, and what a command gives to it; None if it starts no node."""
    for program in ('calibrator', 'checker', 'rig'):
        for start in ([f'dashcalib-{program}'], ['ros2', 'run', 'dashcalib_ros', program]):
            if words[:len(start)] == start:
                return [program, *words[len(start):]]
    return None


def made():
    """Return an accepted calibration for pictures of SIZE."""
    return calibration_of(CAMERA, image_size=SIZE, mask=None,
                          covariance=np.eye(len(CAMERA.params)),
                          picture_covariance=np.eye(len(CAMERA.widened().params)))


@pytest.fixture(scope='module')
def inputs(tmp_path_factory):
    """Make a folder with small inputs by the names that the documents use."""
    place = tmp_path_factory.mktemp('documents')
    frames = drive(6, *SIZE)
    write_bag(place / 'drive', [*images(frames, '/camera/image_raw'),
                                  ('/camera/camera_info', START, info_of(CAMERA))])
    (place / 'drive.mcap').write_bytes(next((place / 'drive').glob('*.mcap')).read_bytes())
    write_ros1(place / 'drive.bag', frames)
    write_folder(place / 'images', frames)
    (place / 'clips').mkdir()
    for name in ('drive.mp4', 'A.mp4', 'B.mp4', 'clips/A.mp4', 'clips/B.mp4'):
        write_video(place / name, smooth(12, *SIZE), codec='mp4v')
    cv2.imwrite(str(place / 'mask.png'), np.full(SIZE[::-1], 255, np.uint8))
    cv2.imwrite(str(place / 'picture.png'), np.zeros((*SIZE[::-1], 3), np.uint8))
    (place / 'clips.csv').write_text('clip,camera\nclips/A.mp4,front\nclips/B.mp4,rear\n')
    # as KITTI writes them: the camera stands
    (place / 'poses.txt').write_text('1 0 0 0 0 1 0 0 0 0 1 0\n' * 12)
    (place / 'settings.yaml').write_text('turns.wanted: 3\n')
    (place / 'camchain.yaml').write_text(
        'cam0:\n  camera_model: ds\n  intrinsics: [-0.2, 0.57, 600, 600, 640, 360]\n'
        '  distortion_model: none\n  distortion_coeffs: []\n  resolution: [1280, 720]\n')
    return place


@pytest.fixture
def sandbox(inputs, monkeypatch):
    """Change to the inputs, with two calibrations as they were before other commands."""
    monkeypatch.chdir(inputs)
    for name in ('calibration', 'other'):
        shutil.rmtree(name, ignore_errors=True)
        write_results(made(), inputs / name)
    shutil.copy('calibration/calibration.yaml', 'camera.yaml')
    return inputs


@pytest.mark.parametrize('words', COMMANDS)
def test_the_command_runs(words, sandbox, capsys, request):
    words = bare(words)
    arguments = node_arguments(words)
    if arguments is not None:
        request.getfixturevalue('starts_and_stops')(arguments)
    elif reason(words) is not None:
        if words[:2] == ['dashcalib', 'demo']:
            make_parser().parse_args(words[1:])
        elif words[0] == 'python' and words[1].startswith('benchmark/'):
            options_exist(words)
    elif words[0] == 'dashcalib':
        expected = {0} if '--help' in words else CODES.get(words[1], {0})
        assert main(words[1:]) in expected, capsys.readouterr().err
    else:
        pytest.fail(f'{" ".join(words)!r} is neither run here nor in CANNOT_RUN')


def options_exist(words):
    script = ROOT / words[1]
    if not script.parent.exists():
        pytest.skip('the source distribution has no benchmarks')
    source = script.read_text() + (ROOT / 'benchmark' / 'measure.py').read_text()
    for word in words[2:]:
        assert not word.startswith('--') or f"'{word}'" in source or f"'{word[2:]}'" in source


@pytest.fixture
def starts_and_stops(tmp_path):
    """Start the node with a command's arguments, as `ros2 run` would, and stop it."""
    pytest.importorskip('rclpy', reason='no ROS on this machine: pip install the ros extra')
    from ros_bench import QUICK_COMMAND, SOON, NodeProcess

    def start(arguments):
        at = arguments.index('--ros-args') if '--ros-args' in arguments else len(arguments)
        node = NodeProcess(tmp_path, *arguments[at + 1:],
                           command=[*QUICK_COMMAND, *arguments[:at]])
        try:
            if '--help' in arguments:
                assert node.process.wait(SOON) == 0 and 'usage' in node.text.lower()
                return
            if 'autostart:=false' in arguments:
                wait_for(lambda: node.catches(signal.SIGTERM))
            else:
                node.wait_for('by turns in' if arguments[0] == 'rig' else 'the turns seen on')
            assert node.stop() == 0, node.text
        finally:
            node.kill()
    return start


@pytest.mark.parametrize('text', PYTHON)
def test_the_python_runs(text, sandbox, monkeypatch):
    """On a drive that knows nothing: only what is calculated from turns is made by hand."""
    monkeypatch.setattr(Calibrator, 'calibrate', lambda self, *_, **__: made())
    exec(compile(text, '<document>', 'exec'), {'__name__': '__main__'})


def test_every_reason_is_of_a_command_in_the_documents():
    used = {reason(each.values[0]) for each in COMMANDS}
    unused = {key for key, why in CANNOT_RUN.items() if why not in used}
    assert unused <= {'rviz2', 'ros2'}, 'remove them from CANNOT_RUN'


def test_commands_are_found_where_they_stand():
    text = 'text\n```bash\na  b # why\nc \\\n  d && e > f | g\n```\n```yaml\nh: 1\n```\n'
    block, other = blocks_of(text, 'X.md')
    assert (block.place, block.language, other.language) == ('X.md:3', 'bash', 'yaml')
    assert commands_of(block) == [['a', 'b'], ['c', 'd'], ['e', '>', 'f'], ['g']]
    assert len(COMMANDS) > 15 and PYTHON


def test_a_command_that_nobody_knows_is_not_excused():
    assert reason(['dashcalib', 'fly']) is None
    assert reason(['dashcalibrate', 'demo']) is None
    assert reason(['sudo', 'apt', 'install', 'x']) and reason(['dashcalib', 'demo'])
    assert reason(['cdrom']) is None
    assert node_arguments(['ros2', 'run', 'dashcalib_ros', 'checker', '-p']) == ['checker', '-p']
    assert node_arguments(['ros2', 'topic', 'list']) is None


def test_a_wrong_option_would_be_noticed(sandbox, capsys):
    assert main(['run', 'drive.mp4', '--no-such-option']) == 2
    assert '--no-such-option' in capsys.readouterr().err
