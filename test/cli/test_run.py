# SPDX-License-Identifier: Apache-2.0
"""The installed core end to end: the demo's bag through the command, in processes of its own."""
from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import zstandard

pytest.importorskip('dashcalib_ros.pipeline')

from processes import processes_of
from waiting import wait_for

from dashcalib_ros.camera import Radial, camera_of
from dashcalib_ros.formats import load_camera
from dashcalib_ros.report import NamedCamera, compare
from dashcalib_ros.workers.worker import THREAD_VARIABLES

COMMAND = (sys.executable, '-m', 'dashcalib_ros')


def dashcalib(*args, env=None, command=COMMAND):
    return subprocess.run([*command, *map(str, args)], capture_output=True, text=True,
                          timeout=600, env=env)


@pytest.fixture(scope='module')
def demo(shared_drive, tmp_path_factory):
    """Run the demo once; return the finished process and its folder, which has the bag, too.

    On a drive that is rendered already, of two turns: to render five takes a minute.
    """
    command = (sys.executable, '-c', f"""
import sys
sys.path.insert(0, {str(Path(__file__).parents[1])!r})
from pathlib import Path
from shared_drive import SharedDrive
from dashcalib_ros import demo
from dashcalib_ros.cli import main
demo.demo_drive = lambda seed, lens: SharedDrive(Path({str(shared_drive.path)!r}), bonnet=True,
                                           timestamp=True)
sys.exit(main())
""")
    out = tmp_path_factory.mktemp('demo') / 'demo'
    # numpy with as many threads as it likes, as users have it
    env = {name: text for name, text in os.environ.items() if name not in THREAD_VARIABLES}
    return dashcalib('demo', '--out', out, '--keep-bag', env=env, command=command), out


@pytest.fixture(scope='module')
def bag(demo):
    """Return the demo's bag."""
    return demo[1] / 'bag'


@pytest.fixture(scope='module')
def calibrated(bag, tmp_path_factory):
    """Calibrate the bag once; return the finished process and the output folder."""
    out = tmp_path_factory.mktemp('out') / 'calibration'
    return dashcalib('run', bag, '--out', out), out


def test_the_demo_s_bag_is_accepted_and_close_to_the_truth(shared_drive, calibrated):
    done, out = calibrated
    assert done.returncode == 0, done.stdout + done.stderr
    assert sorted(p.name for p in out.iterdir()) == [
        'calibration.yaml', 'report.html', 'result.json']
    estimate = load_camera(out / 'calibration.yaml')
    truth = camera_of(Radial.model, estimate.image_size, list(shared_drive.truth.values()))
    rows = {d.name: d for d in compare(estimate, NamedCamera('truth', truth)).differences}
    assert abs(rows['fx'].percent) < 0.5
    assert abs(rows['cx'].percent) < 0.6
    assert abs(rows['k1'].percent) < 2.0


def test_a_pipe_gets_plain_text_and_the_verdict_first(calibrated):
    done, _ = calibrated
    assert '\x1b' not in done.stdout + done.stderr
    assert done.stdout.splitlines()[0] == 'verdict: accepted'
    assert done.stdout.splitlines()[-1].startswith('next: ')
    assert max(map(len, done.stdout.splitlines())) <= 80
    # warnings, and a line of progress from time to time
    assert all(line.startswith('dashcalib: ') for line in done.stderr.splitlines())
    assert 'dashcalib: error' not in done.stderr


def test_the_result_is_complete(bag, calibrated):
    result = json.loads((calibrated[1] / 'result.json').read_text('utf-8'))
    assert sum(turn['used'] for turn in result['turns']) >= 2
    assert all(turn['first'] <= turn['center'] <= turn['last'] for turn in result['turns'])
    assert set(result['timing']) >= {'detect', 'calibrate', 'total'}
    assert set(result['sigma']) == {'fx', 'fy', 'cx', 'cy', 'k1', 'k2'}
    assert all(sigma > 0 for sigma in result['sigma'].values())
    assert str(bag) in result['input'] or bag.name in result['input']


def test_the_same_input_and_seed_give_the_same_result(demo, calibrated):
    """The demo calibrates the same bag, in a process of its own, with other threads of numpy."""
    first, second = (json.loads((out / 'result.json').read_text('utf-8'))
                     for out in (demo[1], calibrated[1]))
    for key in ('intrinsics', 'sigma', 'turns', 'verdict', 'reasons', 'reprojection_error_px'):
        assert first[key] == second[key], key


@pytest.mark.thorough
def test_turns_lists_those_that_a_run_would_use(bag, calibrated):
    done = dashcalib('turns', bag, '--json')
    assert done.returncode == 0, done.stderr
    turns = json.loads(done.stdout)['turns']
    prominences = [turn['prominence'] for turn in turns]
    assert prominences == sorted(prominences, reverse=True)
    run = json.loads((calibrated[1] / 'result.json').read_text('utf-8'))['turns']
    # before the common camera is known, the angles are nearly right
    yaws = {turn['center']: turn['yaw_deg'] for turn in turns}
    assert all(yaws[turn['center']] == pytest.approx(turn['yaw_deg'], rel=0.05) for turn in run)
    assert json.loads(done.stdout)['verdict_at_best'] == 'accepted'


def pictures(folder, count, size=(240, 320)):
    folder.mkdir()
    noise = np.random.default_rng(0).integers(0, 255, (*size, 1), np.uint8)
    for i in range(count):
        cv2.imwrite(str(folder / f'{i:03}.png'), noise)
    return folder


def test_a_drive_that_stands_still_is_refused_with_the_reason(tmp_path):
    done = dashcalib('run', pictures(tmp_path / 'still', 60), '--fps', 10, '--out',
                     tmp_path / 'out')
    assert done.returncode == 3, done.stdout + done.stderr
    result = json.loads((tmp_path / 'out' / 'result.json').read_text('utf-8'))
    assert result['verdict'] == 'refused' and result['reasons']
    assert result['intrinsics'] is None
    assert not (tmp_path / 'out' / 'calibration.yaml').exists()


@pytest.mark.parametrize(('count', 'size'), [(1, (240, 320)), (30, (32, 32))],
                         ids=['one image', 'tiny images'])
def test_too_little_to_work_with_is_told_without_a_traceback(tmp_path, count, size):
    done = dashcalib('run', pictures(tmp_path / 'few', count, size), '--fps', 10, '--out',
                     tmp_path / 'out')
    assert done.returncode in (2, 3)
    assert 'Traceback' not in done.stderr
    assert not (tmp_path / 'out' / 'calibration.yaml').exists()
    if done.returncode == 2:
        assert done.stderr.splitlines()[-1].startswith('dashcalib: error: ')


@pytest.mark.parametrize('name', ['SIGINT', 'SIGTERM'])
@pytest.mark.parametrize('children', [0, 1], ids=['reading', 'reconstructing'])
def test_a_signal_ends_it_whole(bag, tmp_path, name, children):
    """While it reads, or while a child reconstructs a turn."""
    process = subprocess.Popen([*COMMAND, 'run', bag, '--out', tmp_path / 'out'],
                               stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                               start_new_session=True)
    try:
        time.sleep(1.5)
        wait_for(lambda: len(processes_of(process.pid)) > children)
        time.sleep(0.5 * children)
        process.send_signal(getattr(signal, name))
        out, error = process.communicate(timeout=60)
        assert (process.returncode, out) == (130, '')
        assert error.splitlines()[-1] == 'dashcalib: error: interrupted'
        assert 'Traceback' not in error
        assert not (tmp_path / 'out').exists()
        assert processes_of(process.pid) == []
    finally:
        if processes_of(process.pid):
            os.killpg(process.pid, signal.SIGKILL)


@pytest.mark.parametrize('command', ['run', 'batch'])
def test_a_signal_while_a_packed_bag_is_read_leaves_no_copy(bag, tmp_path, command):
    scratch, packed = tmp_path / 'scratch', tmp_path / 'bag.mcap.zstd'
    scratch.mkdir()
    packed.write_bytes(zstandard.compress((bag / 'bag.mcap').read_bytes()))
    manifest = tmp_path / 'clips.csv'
    manifest.write_text(f'clip\n{packed}\n')
    given = manifest if command == 'batch' else packed
    process = subprocess.Popen([*COMMAND, command, given, '--out', tmp_path / 'out', '--quiet'],
                               stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
                               env={**os.environ, 'TMPDIR': str(scratch)})
    try:
        wait_for(lambda: any(scratch.rglob('*.mcap')))
        process.send_signal(signal.SIGTERM)
        error = process.communicate(timeout=60)[1]
        assert error.splitlines()[-1] == 'dashcalib: error: interrupted'
        assert process.returncode == 130
        assert list(scratch.iterdir()) == []
    finally:
        process.kill()
        process.wait()


# Ctrl-C in the main thread while it starts its n-th thread, which runs already
INTERRUPTED_START = """
import sys, threading
from dashcalib_ros.cli import command

class Thread(threading.Thread):
    count = 0

    def start(self):
        super().start()
        if threading.current_thread() is threading.main_thread():
            Thread.count += 1
            if Thread.count == start:
                raise KeyboardInterrupt

threading.Thread = Thread
start = int(sys.argv.pop(1))
command()
"""


# threads that read ahead, look for lines, and wait for the first and the second child
@pytest.mark.parametrize('thread', [1, 2, 3, 4])
def test_a_signal_while_a_thread_starts_ends_it(bag, tmp_path, thread):
    done = dashcalib(str(thread), 'run', bag, '--out', tmp_path / 'out',
                     command=(sys.executable, '-c', INTERRUPTED_START))
    assert done.returncode == 130, done.stderr
    assert done.stderr.splitlines()[-1] == 'dashcalib: error: interrupted'
    assert 'Traceback' not in done.stderr


def test_demo_prints_estimate_sigma_and_truth(demo):
    done, out = demo
    assert done.returncode == 0, done.stdout + done.stderr
    assert 'estimate' in done.stdout and 'truth' in done.stdout
    assert 'mapping error: ' in done.stdout
    assert (out / 'bag' / 'metadata.yaml').exists()
    again = dashcalib('compare', out, out / 'truth.json', '--json')
    assert json.loads(again.stdout)['mapping_px'] is not None
    refused = dashcalib('demo', '--out', out, '--keep-bag')
    assert refused.returncode == 2 and '[E-BAG-EXISTS]' in refused.stderr
