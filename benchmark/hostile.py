#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""What an attacker, a broken driver or a power cut can do: everything must go on, and be answered.

    python benchmark/hostile.py [ATTACK ...] [--quick] [--out DIR] [--results] [--again] [--list]

Each attack is tried many times, each try in its own way. A line goes to DIR/hostile.jsonl after
each try, and one that is there is not tried again; DIR/hostile.md counts them, also those that
were never tried. All of it takes half an hour, and --quick two minutes; ROS is needed.
"""
from __future__ import annotations

import contextlib
import json
import os
import re
import resource
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
import unicodedata
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from measure import commit, keep_table, parser_with, table
from processes import processes_of
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from ros_bench import (
    CAMERA_FILE,
    COMMAND,
    OURS,
    SECOND,
    START,
    Bench,
    NodeProcess,
    compressed_message,
    image_message,
    keep_file,
    noise,
    ros_environment,
)
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CompressedImage, Image
from std_srvs.srv import Trigger

from dashcalib_ros import Calibrator
from dashcalib_ros.camera import Radial, ros_camera
from dashcalib_ros.demo import Drive, DriveSpec, Lens
from dashcalib_ros.errors import DashcalibError, Notice
from dashcalib_ros.formats import load_camera
from dashcalib_ros.formats.ros import camera_of_message
from dashcalib_ros.input import Frame
from dashcalib_ros.input.motion_files import read_motion
from dashcalib_ros.ros.calibrate import camera_info
from dashcalib_ros.ros.images import LASTING
from dashcalib_ros.ros.settings import specs
from dashcalib_ros.ros.store import CameraIdentity, Store

KEPT = CAMERA_FILE.format(width=320) + OURS
FX = 200.0
# s; what takes longer waited for a picture: machines are slow
SLOW_S = 15.0


@dataclass(frozen=True)
class Attack:
    """tries, quick: how often. run: called with a folder and the numbers of the tries that lack.

    It yields once for each when that held, and raises where it did not.
    """

    name: str
    tries: int
    quick: int
    run: Callable[[Path, Sequence[int]], Iterator[None]]


# the node ------------------------------------------------------------------------------------

@contextlib.contextmanager
def running(home: Path, kind: type = Image, command: Sequence[str] = COMMAND, kept: str = KEPT,
            **parameters: Any) -> Iterator[tuple[NodeProcess, Bench]]:
    """Run the node, with a calibration on disk, beside a camera that it hears."""
    home.mkdir(parents=True, exist_ok=True)
    keep_file(home, kept)
    os.environ.update(ros_environment(home))
    context = rclpy.Context()
    rclpy.init(context=context)
    camera = Bench(context, image_type=kind,
                   topic='image_raw' if kind is Image else 'image_raw/compressed')
    node = NodeProcess(home, command=command, image_transport='raw' if kind is Image
                       else 'compressed', **parameters)
    try:
        # until it is configured it publishes nothing
        if parameters.get('autostart', True):
            camera.until(lambda: camera.latched, node=node)
        yield node, camera  # killed afterwards, with its children
        assert node.process.poll() is None, f'the node ended: {node.text[-500:]}'
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(node.process.pid, signal.SIGKILL)
        node.kill()
        camera.close()
        rclpy.shutdown(context=context)


def call(node: NodeProcess, camera: Bench, kind: Any, name: str, **fields: Any) -> Any:
    """Call a service of the node; raises AssertionError where no answer comes."""
    client = camera.node.create_client(kind, f'calibrator/{name}')
    camera.until(client.service_is_ready, node=node)
    future = client.call_async(kind.Request(**fields))
    camera.until(future.done, what=f'the answer of {name}', node=node)
    camera.node.destroy_client(client)
    return future.result()


def still_calibrated(node: NodeProcess, camera: Bench, number: int) -> None:
    """Publish a good image until it has its camera_info."""
    camera.infos.clear()
    make = image_message if camera.images.msg_type is Image else compressed_message
    stamps = iter(range(START + 1000 * number * SECOND, START + 10**6 * SECOND, SECOND))

    def answered() -> bool:
        camera.publish(make(noise(number), next(stamps)))
        camera.spin(0.1)
        return any(info.k[0] == FX for info in camera.infos)
    camera.until(answered, what='the camera_info', node=node)


def kills_while_saving(folder: Path, tries: Sequence[int]) -> Iterator[None]:
    """SIGKILL of the node and its children while it writes its file again and again."""
    for n in tries:
        home = folder / str(n)
        path = home / '.ros' / 'camera_info' / 'dashcam.yaml'
        with running(home) as (node, camera):
            client = camera.node.create_client(Trigger, 'calibrator/save')
            camera.until(client.service_is_ready, node=node)
            end = time.monotonic() + np.random.default_rng(n).uniform(0.1, 1.0)
            while time.monotonic() < end:
                client.call_async(Trigger.Request())
                camera.executor.spin_once(timeout_sec=0.0)
        found = load_camera(path)
        assert (found.verdict, found.camera.fx) == ('accepted', FX), path.read_text()
        assert not processes_of(node.process.pid), 'a child lives on'
        with running(home, kept=path.read_text()) as (node, camera):
            still_calibrated(node, camera, n)
        # the lock of the two nodes stays
        left = {each.name for each in path.parent.iterdir()}
        assert left == {path.name, f'.{path.name}.lock'}, left
        yield


def service_calls(folder: Path, tries: Sequence[int]) -> Iterator[None]:
    """Calls of every kind, with odd names: each is answered."""
    odd = ('', 'turns.wanted', 'x' * 10_000, 'é\n', '/..', 'commit')
    with running(folder) as (node, camera):
        for n in tries:
            name = odd[n % len(odd)]
            calls: list[tuple[type, str, dict[str, Any]]] = [
                (Trigger, ('calibrate', 'reset', 'save')[n % 3], {}),
                (GetParameters, 'get_parameters', {'names': [name]}),
                (DescribeParameters, 'describe_parameters', {'names': [name]}),
                (ListParameters, 'list_parameters', {'prefixes': [name], 'depth': n}),
                (SetParameters, 'set_parameters', {'parameters': [Parameter(name=name)]}),
            ]
            kind, service, fields = calls[n % len(calls)]
            assert call(node, camera, kind, service, **fields) is not None
            yield


def parameter_types(folder: Path, tries: Sequence[int]) -> Iterator[None]:
    """Parameters of each type that a byte can name."""
    with running(folder) as (node, camera):
        for n in tries:
            given = [Parameter(name='turns.wanted', value=ParameterValue(type=n % 256))]
            if n < 256:
                [result] = call(node, camera, SetParameters, 'set_parameters',
                                parameters=given).results
            else:
                result = call(node, camera, SetParametersAtomically, 'set_parameters_atomically',
                              parameters=given).result
            # 0 turns are too few
            assert not result.successful and result.reason
            yield


def transitions(folder: Path, tries: Sequence[int]) -> Iterator[None]:
    """Lifecycle transitions that there are not, in this state or at all."""
    valid = (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_UNCONFIGURED_SHUTDOWN)
    with running(folder, autostart=False) as (node, camera):
        for n in tries:
            wrong = Transition(id=n) if n not in valid else Transition(label='nothing')
            assert not call(node, camera, ChangeState, 'change_state', transition=wrong).success
            yield


def odd_image(n: int) -> Image:
    """Return a raw image that no camera should send; some may be of use."""
    rng = np.random.default_rng(n)
    message = image_message(noise(n), START + n * SECOND)
    message.encoding = str(rng.choice(['mono8', 'bgr8', 'mono16', '32FC1', 'yuv422', 'bayer_rggb8',
                                       'nv12', '', 'é' * 500, 'rgba8']))
    field = rng.choice(['step', 'width', 'height', 'data', 'is_bigendian', 'encoding'])
    if field in ('step', 'width', 'height'):
        setattr(message, field, int(rng.choice([0, 1, 17, 319, 65_535, 2**32 - 1])))
    elif field == 'data':
        del message.data[int(rng.integers(len(message.data))):]
    elif field == 'is_bigendian':
        message.is_bigendian = 255
    return message


def odd_bytes(n: int) -> bytes:
    """Return a damaged file, or the head of one that claims to be large."""
    rng = np.random.default_rng(n)
    kind = ('.jpg', '.png', '.bmp', '.webp', '.tiff', '.pgm')[n % 6]
    whole = cv2.imencode(kind, noise(n))[1].tobytes()
    match n // 6 % 4:
        case 0:
            return whole[:int(rng.integers(len(whole)))]
        case 1:
            data = np.frombuffer(whole, np.uint8).copy()
            data[rng.integers(len(data), size=20)] = rng.integers(256, size=20)
            return data.tobytes()
        case 2:
            return whole[:12] + bytes(rng.integers(256, size=200, dtype=np.uint8))
    # not rng.choice(): numpy's bytes lose the zeros at their end
    heads = b'', b'\xff\xd8', b'GIF89a', b'P5 65535 65535 255\n', b'\0' * 10**6
    return heads[int(rng.integers(len(heads)))]


def odd_images(kind: type, make: Callable[[int], Any]
               ) -> Callable[[Path, Sequence[int]], Iterator[None]]:
    def run(folder: Path, tries: Sequence[int]) -> Iterator[None]:
        with running(folder, kind) as (node, camera):
            still_calibrated(node, camera, 0)
            for n in tries:
                camera.publish(make(n))
                still_calibrated(node, camera, n + 1)
                yield
    return run


def compressed_odd(n: int) -> CompressedImage:
    message = CompressedImage(format=('jpeg', 'png', '', 'h264', 'compressedDepth')[n % 5])
    message.data.frombytes(odd_bytes(n))
    message.header.frame_id = 'camera'
    message.header.stamp.sec = START // SECOND + n
    return message


def other_sizes(folder: Path, tries: Sequence[int]) -> Iterator[None]:
    """Damaged messages that claim another size, for longer than a true change needs."""
    with running(folder, CompressedImage) as (node, camera):
        still_calibrated(node, camera, 0)
        for n in tries:
            whole = cv2.imencode(('.jpg', '.png', '.bmp', '.webp')[n % 4],
                                 noise(n, (640, 480)))[1].tobytes()
            data = b'P5 64 8 9\n' if n % 5 == 0 else whole[:max(64, len(whole) // 2)]
            for _ in range(3 * LASTING):
                message = compressed_odd(n)
                message.format, message.data = 'jpeg', list(data)
                camera.publish(message)
            still_calibrated(node, camera, n + 1)
            assert 'the camera changes' not in node.text
            yield


def camera_infos(_: Path, tries: Sequence[int]) -> Iterator[None]:
    """For a checker: fields of a right camera_info that make its users see wrong."""
    lens = Radial((320, 240), 300.0, 301.0, 161.0, 118.0, -0.1)
    c = ros_camera(lens)
    for n in tries:
        message = camera_info(lens, image_message(noise(0), START).header, 'same')
        assert not camera_of_message(message, '/camera_info').faults
        match n:
            case 0 | 1 | 2 | 3 | 4:
                place = (1, 3, 6, 7, 8)[n]
                message.k = [*c.k[:place], c.k[place] + 50.0, *c.k[place + 1:]]
            case 5 | 6 | 7:
                turned = cv2.Rodrigues(np.radians(10.0) * np.eye(3)[n - 5])[0]
                message.r = turned.ravel().tolist()
            case 8 | 9 | 10:
                scale = (0.5, 1.5, 2.0)[n - 8]
                message.p = [scale * value for value in c.p[:8]] + c.p[8:]
            case 11 | 12:
                setattr(message, 'rp'[n - 11], [0.0] * (9, 12)[n - 11])
            case 13 | 14:
                setattr(message, ('binning_x', 'binning_y')[n - 13], 2)
            case 15:
                message.roi.x_offset, message.roi.width, message.roi.height = 8, 320, 240
            case _:
                message.p = [float('nan'), *c.p[1:]]
        with contextlib.suppress(DashcalibError):
            assert camera_of_message(message, '/camera_info').faults, message
        yield


def frames(_: Path, tries: Sequence[int]) -> Iterator[None]:
    for n in tries:
        stamp: Any = (float('nan'), float('inf'), -float('inf'), 10**400, None, 'x', [1], 1j)[n]
        try:
            Frame(0, stamp, noise(0))
        except DashcalibError:
            yield
        else:
            raise AssertionError(f'a stamp of {stamp} is taken')


# files and fleets ----------------------------------------------------------------------------

def damaged(text: str, n: int) -> bytes:
    """Return a text with something odd in it, in place of a number, a line, or some bytes."""
    rng = np.random.default_rng(n)
    odd = ['.nan', '1e999', '-5', '"x"', '[]', '{}', '9' * 400, '~', '*a', '1:20:30', 'null',
           '!!python/object/apply:os.system ["true"]', '[' * 50 + ']' * 50, '\0', '0x10', 'é']
    lines = text.splitlines()
    line = int(rng.integers(len(lines)))
    match n % 5:
        case 0:
            numbers = list(re.finditer(r'-?\d+(\.\d+)?', text))
            place = numbers[rng.integers(len(numbers))]
            return (text[:place.start()] + odd[n // 5 % len(odd)] + text[place.end():]).encode()
        case 1:
            return '\n'.join(lines[:line] + lines[line + 1:]).encode()
        case 2:
            return text.encode()[:int(rng.integers(len(text)))]
        case 3:
            key = lines[line].partition(':')[0]
            lines[line] = f'{key}: {odd[n // 5 % len(odd)]}'
            return '\n'.join(lines).encode()
    data = np.frombuffer(text.encode(), np.uint8).copy()
    data[rng.integers(len(data), size=5)] = rng.integers(256, size=5)
    return data.tobytes()


def kept(path: Path) -> Any:
    """Return what a node would use of a file."""
    store = Store(path, CameraIdentity('dashcam', '/image_raw'))
    try:
        return store.load()
    finally:
        store.close()


def calibration_files(folder: Path, tries: Sequence[int]) -> Iterator[None]:
    """Each is read as a camera with finite numbers, or refused with one line."""
    for n in tries:
        path = folder / f'{n}.yaml'
        path.write_bytes(damaged(KEPT, n))
        for read in (load_camera, kept):
            try:
                found = read(path)
            except DashcalibError as error:
                assert '\n' not in str(error)
            else:
                camera = getattr(found.camera, 'camera', found.camera)
                assert np.isfinite(camera.params).all() and camera.fx > 0
        yield


def spoil(path: Path, n: int) -> None:
    """Damage a file of arrays: cut it off, or replace it. test/store has what is wrong inside."""
    whole = path.read_bytes()
    path.write_bytes((whole[:n * len(whole) // 100], os.urandom(5000), b'')[n % 3])
    if n % 10 == 9:
        np.savez(path, weights=np.zeros(n))


def stores(folder: Path, tries: Sequence[int]) -> Iterator[None]:
    """A damaged turn costs one warning, and the others stay."""
    from fleet_made import YAWS, clip_of

    from dashcalib_ros.detect import TurnId
    from dashcalib_ros.input.scale import Scale
    from dashcalib_ros.store.scene_file import Origin
    from dashcalib_ros.store.turn_store import TurnStore
    origin = Origin((800, 450), Scale(), 'camera')
    turns = clip_of(yaws=YAWS[:2], tracks=60, keyframes=8).turns
    for n in tries:
        said: list[Notice] = []
        store = TurnStore(str(folder / str(n)), 10, 3.0, said.append)
        store.load(origin)
        store.mirror({TurnId.at(100 + k): turn for k, turn in enumerate(turns)})
        spoil(sorted((folder / str(n)).iterdir())[0], n)
        again = TurnStore(str(folder / str(n)), 10, 3.0, said.append)
        again.load(origin)
        assert len(again.turns) == 1 and len(said) == 1, said
        yield


def dashcalib(*arguments: object) -> list[str]:
    return [sys.executable, '-m', 'dashcalib_ros', *map(str, arguments)]


def manifests(folder: Path, tries: Sequence[int]) -> Iterator[None]:
    """Each is told in lines without a traceback, and writes nothing elsewhere."""
    text = 'clip,camera,make,fps,topic,time\n' + 'a.mp4,one,acme,10,/image,2026-01-31\n' * 3
    for n in tries:
        place = folder / str(n)
        place.mkdir()
        names = ['m.csv', 'm.jsonl', 'm.parquet']
        path = place / names[n % 3]
        path.write_bytes(damaged(text if n % 3 != 1 else '{"clip": "../a.mp4", "fps": 10}\n', n))
        done = subprocess.run(dashcalib('batch', path, '--out', place / 'out', '--workers', 1),
                              capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode in (2, 3) and 'Traceback' not in done.stderr, done.stderr
        assert {each.name for each in place.iterdir()} <= {path.name, 'out'}
        yield


def batch_kills(folder: Path, tries: Sequence[int]) -> Iterator[None]:
    """SIGKILL of a batch again and again: what comes out in the end is the same to the byte."""
    from fleet_made import YAWS, clip_of, lens_of, written
    rows = ['clip,camera,make']
    for n in range(4):
        written(clip_of(lens_of(1 + 0.004 * n), YAWS[n:n + 1], world=n, tracks=60, keyframes=7),
                folder / f'{n}.npz')
        rows.append(f'{n}.npz,cam {n},acme')
    (folder / 'm.csv').write_text('\n'.join(rows) + '\n')

    # the pages name the folder
    out = folder / 'out'

    def start() -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            dashcalib('batch', folder / 'm.csv', '--out', out, '--workers', 1, '--set',
                      'intrinsics.profile_tracks=60'), start_new_session=True,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def written_files() -> dict[str, bytes]:
        # the effort is of the last run alone
        found = {str(path.relative_to(out)): path.read_bytes() for path in out.rglob('*')
                 if path.is_file() and path.name != 'effort.json'}
        shutil.rmtree(out)
        return found

    started = time.monotonic()
    start().wait()
    took = time.monotonic() - started
    wanted = written_files()
    for n in tries:
        rng = np.random.default_rng(n)
        for kill in range(4):
            process = start()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(None if kill == 3 else rng.uniform(0.3, 1.0) * took)
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        found = written_files()
        assert found == wanted, sorted(name for name in {*found, *wanted}
                                       if found.get(name) != wanted.get(name))
        yield


def two_turns(pictures: Path) -> Path:
    """Write the pictures of a drive that is accepted, and return their folder."""
    pictures.mkdir()
    lens = Lens.of(640, 360, 75.0, -0.30, 0.10, offset=(9.0, -6.0), aspect=1.003)
    for frame in Drive(lens, DriveSpec(seed=0, turns=2)).frames(processes=2):
        cv2.imwrite(str(pictures / f'{frame.index:06}.png'), frame.image)
    return pictures


# Ctrl-C at the n-th place in the code of threads, locks and processes where Python looks for
# signals: after a call into C, and where a function begins. A run that is not interrupted prints
# how many such places there were
INTERRUPTED = """
import atexit, sys
from dashcalib_ros.cli import command

wanted, lines = int(sys.argv.pop(1)), 0
files = ('threading.py', 'futures/', 'queue.py', 'subprocess.py', 'contextlib.py', 'workers/',
         'selection.py', 'recorded.py', 'calibrator.py', 'edges.py', 'cli/drive.py')

def looked(frame, event, _):
    global lines
    if event in ('call', 'c_return') and any(
            each in frame.f_code.co_filename for each in files):
        lines += 1
        if lines == wanted:
            sys.setprofile(None)
            raise KeyboardInterrupt

atexit.register(lambda: print(lines))
sys.setprofile(looked)
command()
"""


def interrupts(folder: Path, tries: Sequence[int]) -> Iterator[None]:
    """Ctrl-C at any line: the command ends, says so in one line, and leaves nothing."""
    pictures, out = two_turns(folder / 'pictures'), folder / 'out'

    def run(line: int) -> tuple[int, str, str]:
        process = subprocess.Popen(
            [sys.executable, '-c', INTERRUPTED, str(line), 'run', str(pictures), '--fps', '10',
             '--out', str(out)], start_new_session=True, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True)
        try:
            written, said = process.communicate(timeout=60)
        finally:
            left = processes_of(process.pid)
            if left:
                os.killpg(process.pid, signal.SIGKILL)
        assert not left, left
        return process.returncode, written, said

    lines = int(run(0)[1].split()[-1])
    for n in tries:
        shutil.rmtree(out, ignore_errors=True)
        line = int(np.random.default_rng(n).integers(1, lines))
        code, _, said = run(line)
        # in the last lines, the work is done
        done = code == 0 and (out / 'result.json').exists()
        assert done or (code, said, out.exists()) == (
            130, 'dashcalib: error: interrupted\n', False), f'line {line}: {code}: {said}'
        yield


def child_kills(folder: Path, tries: Sequence[int]) -> Iterator[None]:
    """SIGKILL of children that calibrate: the result is the same, and no process is left."""
    pictures = two_turns(folder / 'pictures')

    def calibrated(moments: Sequence[float]) -> tuple[dict[str, Any], str]:
        out = folder / 'out'
        process = subprocess.Popen(
            dashcalib('run', pictures, '--fps', 10, '--out', out), start_new_session=True,
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        begun = time.monotonic()
        for moment in moments:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(max(moment - (time.monotonic() - begun), 0.0))
            children = set(processes_of(process.pid)) - {process.pid}
            for child in children:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(child, signal.SIGKILL)
        said = process.communicate(timeout=300)[1]
        assert process.returncode in (0, 3), said
        assert 'Traceback' not in said and not processes_of(process.pid)
        found = json.loads((out / 'result.json').read_text())
        shutil.rmtree(out)
        return {key: found[key] for key in ('verdict', 'intrinsics', 'sigma', 'turns')}, said

    begun = time.monotonic()
    wanted, _ = calibrated(())
    took = time.monotonic() - begun
    for n in tries:
        moments = np.sort(np.random.default_rng(n).uniform(0.2, 1.0, 1 + n % 2)) * took
        found, said = calibrated(list(moments))
        # a turn that ended its worker twice is left out, in so many words
        assert found == wanted or 'tried again' in said, said
        yield


def pipes(folder: Path, tries: Sequence[int]) -> Iterator[None]:
    """A FIFO in the place of any file: one line at once, as nobody writes into it."""
    pipe, text = folder / 'pipe', folder / 'm.csv'
    os.mkfifo(pipe)
    text.write_text('clip\npipe\n')
    (folder / 'pictures').mkdir()
    os.mkfifo(folder / 'pictures' / '0001.png')
    kept, films = folder / 'kept.yaml', folder / 'films'
    kept.write_text(KEPT)
    films.mkdir()
    for n in range(12):
        cv2.imwrite(str(films / f'{n:04}.png'), noise(n))
    given = [('run', pipe), ('run', folder / 'pictures', '--fps', 10),
             ('run', films, '--fps', 10, '--mask', pipe),
             ('run', films, '--fps', 10, '--config', pipe), ('check', pipe, films, '--fps', 10),
             ('check', kept, pipe), ('compare', kept, pipe), ('export', pipe, '--to', 'rays'),
             ('turns', pipe), ('batch', pipe), ('batch', text)]
    for n in tries:
        arguments = given[n % len(given)]
        out = () if arguments[0] in ('compare', 'turns') else ('--out', folder / f'out{n}')
        done = subprocess.run(dashcalib(*arguments, *out), capture_output=True, text=True,
                              timeout=60, check=False)
        assert done.returncode in (2, 3) and 'Traceback' not in done.stderr, done.stderr
        yield


def scene_files(folder: Path, tries: Sequence[int]) -> Iterator[None]:
    """A damaged clip of scenes costs its own row; nothing is written beside the output."""
    from fleet_made import YAWS, clip_of, lens_of, written
    for n in tries:
        place = folder / str(n)
        for m in range(2):
            written(clip_of(lens_of(), YAWS[m:m + 1], world=m, tracks=60, keyframes=7),
                    place / f'{m}.npz')
        spoil(place / '1.npz', n)
        (place / 'm.csv').write_text('clip,camera\n0.npz,one\n1.npz,one\n')
        before = {path.name for path in place.iterdir()}
        done = subprocess.run(
            dashcalib('batch', place / 'm.csv', '--out', place / 'out', '--workers', 1, '--set',
                      'intrinsics.profile_tracks=60'),
            capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode in (0, 2, 3) and 'Traceback' not in done.stderr, done.stderr
        assert {path.name for path in place.iterdir()} <= {*before, 'out'}
        cameras = list((place / 'out').rglob('result.json'))
        assert len(cameras) == 1, done.stderr
        yield


# what is left behind, and ends ----------------------------------------------------------------

# writes half a bag, and then the rest
WRITER = """
import sys
from pathlib import Path
from dashcalib_ros.camera import Radial
from dashcalib_ros.input.bag_write import write_bag
lens = Radial((320, 240), 300.0, 301.0, 161.0, 118.0, -0.1)
print(write_bag(sys.argv[1], '/camera', lens, sys.argv[2]), flush=True)
"""


def names_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def bag_kills(folder: Path, tries: Sequence[int]) -> Iterator[None]:
    """SIGKILL of --write-bag at any moment: the next one leaves its own bag alone."""
    import made_drives
    bag = made_drives.write_bag(folder / 'drive', made_drives.images(
        made_drives.drive(400, 320, 240)))

    def start(out: Path) -> subprocess.Popen[bytes]:
        return subprocess.Popen([sys.executable, '-c', WRITER, str(bag), str(out)],
                                stdout=subprocess.DEVNULL)

    for n in tries:
        place, rng = folder / str(n), np.random.default_rng(n)
        process = start(place / 'first')
        while process.poll() is None and not (place.exists() and names_in(place)):
            time.sleep(0.001)
        time.sleep(rng.uniform(0, 0.2))
        process.kill()
        process.wait()
        whole = names_in(place) & {'first'}
        assert start(place / 'second').wait() == 0
        assert names_in(place) == {*whole, 'second'}, names_in(place)
        shutil.rmtree(place)
        yield


def scratch(folder: Path, tries: Sequence[int]) -> Iterator[None]:
    """Commands leave nothing in TMPDIR, nor where they run, be they right or wrong."""
    pictures, home, tmp = two_turns(folder / 'pictures'), folder / 'home', folder / 'tmp'
    home.mkdir()
    tmp.mkdir()
    given = folder / 'given.json'
    for n in tries:
        # one that a check finds wrong makes Ceres warn
        f = 417.0 * (1.0, 0.9, 1.2, 0.5, 2.0)[n % 5]
        given.write_text(json.dumps({'fx': f, 'fy': f, 'cx': 320.0, 'cy': 180.0, 'k1': -0.3,
                                     'k2': 0.1, 'width': 640, 'height': 360}))
        command = (('check', given, pictures), ('run', pictures, '--out', folder / 'out'))[n // 5]
        done = subprocess.run(dashcalib(*command, '--fps', 10), cwd=home, capture_output=True,
                              env={**os.environ, 'TMPDIR': str(tmp)}, timeout=300, check=False)
        assert done.returncode in (0, 1, 3), done.stderr
        left = names_in(tmp) | names_in(home)
        for each in (*tmp.iterdir(), *home.iterdir()):
            each.unlink()
        assert not left, left
        yield


def batch_leftovers(folder: Path, tries: Sequence[int]) -> Iterator[None]:
    """SIGKILL of a batch and its children while packed clips are read: the next one tidies."""
    import made_drives
    import zstandard
    bag = made_drives.write_bag(folder / 'drive', made_drives.images(
        made_drives.drive(300, 320, 240)))
    packed = folder / 'bag.mcap.zstd'
    packed.write_bytes(zstandard.compress(made_drives.storage(bag).read_bytes()))
    (folder / 'm.csv').write_text('clip\n' + f'{packed}\n')
    for n in tries:
        tmp, out = folder / f'tmp{n}', folder / f'out{n}'
        tmp.mkdir()
        environment = {**os.environ, 'TMPDIR': str(tmp)}
        command = dashcalib('batch', folder / 'm.csv', '--out', out, '--workers', 2)
        process = subprocess.Popen(command, env=environment, start_new_session=True,
                                   stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while process.poll() is None and not names_in(tmp):
            time.sleep(0.001)
        time.sleep(np.random.default_rng(n).uniform(0, 0.3))
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        # of another program, and of a process that lives
        (tmp / 'dashcalib-other').mkdir()
        subprocess.run(command, env=environment, capture_output=True, timeout=300, check=False)
        assert names_in(tmp) == {'dashcalib-other'}, names_in(tmp)
        yield


def full_disks(folder: Path, tries: Sequence[int]) -> Iterator[None]:
    """The results do not fit: the calibration is told all the same, and one line says why."""
    pictures = two_turns(folder / 'pictures')
    for n in tries:
        json_too = ('--json', '-') if n % 2 else ()
        # no file may be larger than this, as on a disk that is nearly full
        limit = int(np.random.default_rng(n).uniform(10, 50_000))
        done = subprocess.run(
            ['prlimit', f'--fsize={limit}', *dashcalib(
                'run', pictures, '--fps', 10, '--out', folder / 'out', *json_too)],
            capture_output=True, text=True, timeout=300, check=False)
        assert done.returncode == 2 and 'cannot write to' in done.stderr, done.stderr
        assert 'Traceback' not in done.stderr and 'fx' in done.stdout, done.stdout
        assert not json_too or json.loads(done.stdout)['intrinsics']['fx'] > 0
        assert not (folder / 'out').exists()
        yield


def bags_into_nowhere(folder: Path, tries: Sequence[int]) -> Iterator[None]:
    """--write-bag to where nothing can be: said before anything is calibrated."""
    import made_drives
    bag = made_drives.write_bag(folder / 'drive', made_drives.images(
        made_drives.drive(400, 320, 240)))
    (folder / 'file').touch()
    (folder / 'link').symlink_to(folder / 'nowhere')
    places = ('file/bag', 'link', '/proc/bag', 'drive', 'out', 'x' * 300, '/dev/null/bag', '')
    for n in tries:
        before = names_in(folder)
        done = subprocess.run(
            dashcalib('run', bag, '--out', folder / 'out', '--write-bag',
                      folder / places[n % len(places)]),
            capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 2 and len(done.stderr.splitlines()) == 1, done.stderr
        assert '[E-OUTPUT-' in done.stderr, done.stderr
        assert names_in(folder) == before
        yield


def old_stores(folder: Path, tries: Sequence[int]) -> Iterator[None]:
    """A store of another camera of the same size moves no calibration farther than its sigma."""
    from dataclasses import replace

    from fleet_made import YAWS, clip_of

    from dashcalib_ros.store.scene_file import SceneFile, encoded
    pictures = two_turns(folder / 'pictures')
    true = Lens.of(640, 360, 75.0, -0.30, 0.10, offset=(9.0, -6.0), aspect=1.003)
    lens = Radial((640, 360), *(getattr(true, name) for name in (
        'fx', 'fy', 'cx', 'cy', 'k1', 'k2')))
    others = [replace(lens, fx=lens.fx * by, fy=lens.fy * by)
              for by in (0.8, 0.9, 0.95, 0.97, 0.98, 0.99, 1.01, 1.02, 1.03, 1.05, 1.1, 1.25)]
    others += [replace(lens, cx=lens.cx + 15), replace(lens, cy=lens.cy - 15),
               replace(lens, k1=0.0, k2=0.0), replace(lens, fy=lens.fy * 1.02)]
    for n in tries:
        store = folder / f'store{n}'
        store.mkdir()
        # five turns, sharper than those of the drive
        made = clip_of(others[n % len(others)], YAWS[:5], world=n, tracks=150, keyframes=12)
        for m, turn in enumerate(made.turns):
            (store / f'turn-{m:016x}.npz').write_bytes(encoded(SceneFile(
                made.origin, (replace(turn, prominence=0.5),), 1)))
        # of its own, two turns or one
        part = () if n < len(others) else ('--duration', 14)
        out = folder / f'out{n}'
        done = subprocess.run(
            dashcalib('run', pictures, '--fps', 10, '--out', out, '--set',
                      f'turns.store={store}', *part),
            capture_output=True, text=True, timeout=300, check=False)
        assert done.returncode in (0, 3) and 'Traceback' not in done.stderr, done.stderr
        found = json.loads((out / 'result.json').read_text())
        print(n, found['verdict'], found['intrinsics'] and found['intrinsics']['fx'] / lens.fx)
        if found['verdict'] == 'accepted':
            for name, sigma in found['sigma'].items():
                off = found['intrinsics'][name] - getattr(lens, name, 0.0)
                assert abs(off) < 4 * sigma, f'{name} is {off:.4f} off, sigma {sigma:.4f}'
        yield


LEFT = [
    Attack('SIGKILL while a bag is written', 40, 3, bag_kills),
    Attack('what is left in TMPDIR', 6, 2, scratch),
    Attack('SIGKILL of a batch of packed clips', 20, 2, batch_leftovers),
    Attack('no room for the results', 6, 2, full_disks),
    Attack('a bag into nowhere', 8, 8, bags_into_nowhere),
    Attack('an old turn store of another camera', 32, 2, old_stores)]
# two cameras, and pictures that take long ------------------------------------------------------

def other_view(n: int) -> Callable[[Any], Any]:
    """Return what another camera shows: longer lenses, mirrored, another mounting."""
    size, middle = (640, 360), np.array([319.5, 179.5])
    if n % 6 == 5:
        return lambda image: np.ascontiguousarray(image[:, ::-1])
    zoom, roll = ((1.1, 0.0), (1.03, 0.0), (0.95, 0.0), (1.0, 4.0), (1.05, 2.0))[n % 6]
    matrix = cv2.getRotationMatrix2D(tuple(middle), roll, zoom)
    return lambda image: cv2.warpAffine(image, matrix, size, borderMode=cv2.BORDER_REFLECT)


def two_cameras(_: Path, tries: Sequence[int]) -> Iterator[None]:
    """Images of another camera where thinning leaves images out: refused; without them not."""
    lens = Lens.of(640, 360, 75.0, -0.30, 0.10, offset=(9.0, -6.0), aspect=1.003)
    films = {rate: [frame.image for frame in Drive(lens, DriveSpec(
        seed=0, turns=2, rate=rate, rolling_shutter_ms=20.0)).frames()] for rate in (20.0, 30.0)}
    sound = len(films)
    for n in tries:
        rate = (20.0, 30.0)[n % 2]
        pattern = ('AB', 'ABA', 'AB', 'AAB')[n % 4]
        other = other_view(n // 2)
        with Calibrator() as calibrator:
            for number, image in enumerate(films[rate]):
                is_other = n >= sound and pattern[number % len(pattern)] == 'B'
                calibrator.push(Frame(number, round(number * 1e9 / rate),
                                      other(image) if is_other else image))
            found = calibrator.calibrate()
        told = any('two cameras' in str(reason) for reason in found.verdict.reasons)
        assert (found.verdict.level, told) == (
            ('accepted', False) if n < sound else ('refused', True)), found.verdict
        yield


def two_publishers(folder: Path, tries: Sequence[int]) -> Iterator[None]:
    """A second publisher comes and goes: no camera_info meanwhile, and no save; then all again."""
    with running(folder) as (node, camera):
        still_calibrated(node, camera, 0)
        for n in tries:
            second = Bench(camera.node.context, listen=False, name='rear')
            camera.until(lambda: '/rear' in camera.values.get('publishers', ''), node=node)
            camera.infos.clear()
            for number in range(5):
                for each in (camera, second):
                    each.publish(image_message(noise(number), START + (100 * n + number) * SECOND))
            answer = call(node, camera, Trigger, 'save')
            assert not answer.success and '/rear' in answer.message and not camera.infos
            second.close()
            camera.until(lambda: '/rear' not in camera.values['publishers'], node=node)
            still_calibrated(node, camera, n + 1)
            yield


def slow_pictures(folder: Path, tries: Sequence[int]) -> Iterator[None]:
    """Small pictures that take a second to a minute to decode: all else goes on meanwhile."""
    from hostile_pictures import SLOW
    pictures = [make() for make in SLOW.values()]
    with running(folder, CompressedImage) as (node, camera):
        still_calibrated(node, camera, 0)
        for n in tries:
            message = compressed_odd(0)
            message.format, message.data = 'jpeg', []
            message.data.frombytes(pictures[n % len(pictures)])
            for _ in range(LASTING):
                camera.publish(message)
            begun = time.monotonic()
            assert call(node, camera, Trigger, 'save').success
            still_calibrated(node, camera, n + 1)
            assert time.monotonic() - begun < SLOW_S, 'the node waited for a picture'
            yield


def hangups(folder: Path, tries: Sequence[int]) -> Iterator[None]:
    """SIGHUP at any moment of the first seconds: the node ends cleanly, its children too."""
    for n in tries:
        node = NodeProcess(folder, command=COMMAND)
        try:
            node.wait_for('learning the camera')
            time.sleep(np.random.default_rng(n).uniform(0.0, 1.0))
            assert node.stop(signal.SIGHUP) == 0, node.text
            assert not processes_of(node.process.pid) and 'Traceback' not in node.text
        finally:
            node.kill()
        yield


def jumping_clock(folder: Path, tries: Sequence[int]) -> Iterator[None]:
    """With use_sim_time, a clock that stands, leaps and goes back: each image is answered."""
    with running(folder, use_sim_time=True) as (node, camera):
        clock = camera.node.create_publisher(Clock, '/clock', 10)
        for n in tries:
            rng = np.random.default_rng(n)
            now = int(rng.choice([0, 1, START // SECOND, 2**31 - 1, START // SECOND - 10**6]))
            for _ in range(int(rng.integers(1, 5))):
                message = Clock()
                message.clock.sec = now
                clock.publish(message)
            camera.status = None
            still_calibrated(node, camera, n)
            camera.until(lambda: camera.status, what='/diagnostics', node=node)
            yield


def odd_parameters(folder: Path, tries: Sequence[int]) -> Iterator[None]:
    """Any parameter with any value at the start: the node runs, or ends with one line."""
    names = sorted(specs())
    odd = ['-1', '0', '1e308', '.nan', '.inf', '99999999999999999999', "''", "'/'", "'a b'", '[]',
           "['a', 'b']", 'true', "'~nobody/x'", "'../../x'", "'é\\n'", '[1.5, 2.5]']
    for n in tries:
        name, value = names[37 * n % len(names)], odd[n % len(odd)]
        node = NodeProcess(folder, '-p', f'{name}:={value}', command=COMMAND)
        try:
            end = time.monotonic() + 30
            while node.process.poll() is None and 'learning the camera' not in node.text:
                assert time.monotonic() < end, node.text
                time.sleep(0.05)
            if node.process.poll() is None:
                assert node.stop(signal.SIGTERM) == 0
            else:
                assert node.process.returncode == 2, f'{name}:={value}: {node.text}'
                lines = node.text.splitlines()
                assert lines[-1].startswith('calibrator: error: '), f'{name}:={value}: {node.text}'
            assert 'Traceback' not in node.text, f'{name}:={value}: {node.text}'
        finally:
            node.kill()
        yield


# small files that become large, and texts that act ------------------------------------------

# bytes of memory and s that the smallest command may take with any small file
MOST_BYTES, MOST_S = 4 * 2**30, 60
FORGED = 'a\x1b[2J\x9b1m\u202eb\nverdict: accepted'


def limited(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run the command within memory and time; it ends with one line, without a traceback."""
    done = subprocess.run(
        dashcalib(*arguments), capture_output=True, text=True, timeout=MOST_S, check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, MOST_BYTES)))
    assert 'Traceback' not in done.stderr and 'out of memory' not in done.stderr, done.stderr
    acting = [sign for sign in done.stdout + done.stderr
              if sign != '\n' and unicodedata.category(sign) in ('Cc', 'Cf')]
    assert not acting, acting
    return done


def endless_databases() -> list[str]:
    """Return SQL that makes bags of more than they store."""
    topics = ("CREATE TABLE topics(id, name, type, serialization_format, offered_qos_profiles); "
              "INSERT INTO topics VALUES(1, '/camera', 'sensor_msgs/msg/Image', 'cdr', '');")
    count = 'WITH RECURSIVE c(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM c{}) '
    blob = 10**6 * '00'
    return [
        f'{topics} CREATE VIEW messages AS {count.format("")} SELECT n id, 1 topic_id, n '
        f'timestamp, zeroblob(1000) data FROM c',
        f'{topics} CREATE VIEW messages AS SELECT 1 id, 1 topic_id, 1 timestamp, '
        f'randomblob(900000000) data',
        f'{topics} CREATE TABLE messages(id, topic_id, timestamp, data AS '
        f'(zeroblob(900000000))); INSERT INTO messages {count.format(" LIMIT 10000")} '
        f'SELECT n, 1, n FROM c',
        f"{topics} CREATE TABLE messages(id, topic_id, timestamp, data DEFAULT x'{blob}'); INSERT "
        f"INTO messages(id, topic_id, timestamp) {count.format(' LIMIT 10000')} SELECT n, 1, n "
        f"FROM c",
        f"{topics} INSERT INTO topics {count.format(' LIMIT 9000')} SELECT 1, n, '', '', '' FROM "
        f"c; CREATE TABLE messages(id, topic_id, timestamp, data); INSERT INTO messages "
        f"{count.format(' LIMIT 100000')} SELECT n, 1, n, x'00' FROM c"]


def packed_bag(path: Path, same_time: bool, indexed: bool) -> None:
    """Write an MCAP of 200 chunks of 256 MB each, in less than 10 MB."""
    from mcap.writer import CompressionType, IndexType, Writer
    with path.open('wb') as stream:
        writer = Writer(stream, chunk_size=1, compression=CompressionType.ZSTD,
                        index_types=IndexType.ALL if indexed else IndexType.NONE)
        writer.start('ros2', 'hostile')
        schema = writer.register_schema('sensor_msgs/msg/Image', 'ros2msg', b'')
        channel = writer.register_channel('/camera', 'cdr', schema)
        data = bytes(2**28 - 100)
        for n in range(200):
            stamp_ns = 1 if same_time else n + 1
            writer.add_message(channel, stamp_ns, data, stamp_ns)
        writer.finish()


def bombs(folder: Path, tries: Sequence[int]) -> Iterator[None]:
    """Small files of each kind that become large, or take for ever; the bound is the command's."""
    csv, gpx, npz = folder / 'm.csv', folder / 'm.gpx', folder / 'm.npz'
    for n in tries:
        path = folder / f'{n}'
        match n:
            case 0 | 1 | 2 | 3 | 4:
                path = path.with_suffix('.db3')
                with sqlite3.connect(path) as database:
                    database.executescript(endless_databases()[n] + ';')
                assert limited('turns', path).returncode == 2
            case 5 | 6 | 7:
                path = path.with_suffix('.mcap')
                packed_bag(path, n == 6, n != 7)
                assert path.stat().st_size < 10**7
                assert limited('turns', path).returncode == 2
            case 8:
                names = ','.join(['stamp_s', 'speed', *(f'a{k}' for k in range(20_000))])
                csv.write_text('\n'.join([names, *20_000 * ['1']]))
                assert read_motion(csv).empty
            case 9 | 10 | 11 | 12:
                gpx.write_text('<gpx ' + [
                    ' '.join(f'xmlns:n{k}="u{k}"' for k in range(100_000)) + '/>',
                    '>' + 10**6 * '<a>', '>' + ''.join(f'<a{k}/>' for k in range(10**6)),
                    'a="' + 10**8 * 'x' + '"/>'][n - 9])
                try:
                    read_motion(gpx)
                except DashcalibError:
                    pass
                else:
                    raise AssertionError('it is taken')
            case 13:
                csv.write_text('clip,camera\n' + ''.join(f'{k}.mp4,{k}\n' for k in range(10**5)))
                done = limited('batch', csv, '--out', folder / 'out', '--workers', 1, '--quiet')
                assert done.returncode == 3, done.stderr
            case 14:
                np.savez(npz, allow_pickle=True, K=np.array([Path]), fx=np.array(1.0))
                assert limited('export', npz, '--to', 'ros').returncode == 2
            case _:
                with zipfile.ZipFile(npz, 'w', zipfile.ZIP_BZIP2) as packed:
                    packed.writestr('K.npy', bytes(2**30))
                assert limited('export', npz, '--to', 'ros').returncode == 2
        yield


def numbers(folder: Path, tries: Sequence[int]) -> Iterator[None]:
    """Numbers that a file may say and no lens has, in compare and export."""
    right, wrong = folder / 'right.yaml', folder / 'wrong.yaml'
    right.write_text(KEPT)
    places = ('200.0, 0.0, 160.0', '0.0, 201.0, 120.0', '-0.1, 0.01')
    for n in tries:
        value = ('1e300', '-1e300', '1e-300', '1e12', '.inf', '.nan')[n // 3 % 6]
        wrong.write_text(KEPT.replace(places[n % 3], ', '.join(
            [value, *places[n % 3].split(', ')[1:]])))
        for arguments in (('compare', right, wrong), ('compare', wrong, right), (
                'export', wrong, '--to', 'rays', '--out', folder / 'rays.npz')):
            assert limited(*arguments).returncode in (0, 2)
        assert limited('export', right, '--to', 'ros', '--size', '0x0').returncode == 2
        yield


def forged_texts(folder: Path, tries: Sequence[int]) -> Iterator[None]:
    """Names that clear a screen, forge a line or are formulas: they are shown, and do nothing."""
    kept, bag = folder / FORGED, folder / 'bag.mcap'
    kept.write_text(KEPT)
    write_mcap_of(bag, FORGED)
    csv = folder / 'm.csv'
    csv.write_text(f'clip,camera,make\ngone.mp4,"{FORGED}","=cmd|\'/c calc\'!A1"\n')
    given = [('compare', kept, kept), ('compare', folder / f'{FORGED}.gone', kept),
             ('export', kept, '--to', 'ros'), ('turns', kept), ('turns', bag),
             ('turns', bag, '--topic', FORGED), ('check', kept, bag),
             ('batch', csv, '--out', folder / 'out', '--workers', 1)]
    for n in tries:
        done = limited(*given[n])
        assert '\nverdict: accepted' not in done.stdout + done.stderr
        if given[n][0] == 'batch':
            assert ',"\'=cmd' in (table := (folder / 'out' / 'cameras.csv').read_text()) or (
                ",'=cmd" in table)
        yield


def write_mcap_of(path: Path, topic: str) -> None:
    """Write a bag with a message on a topic of any name."""
    from mcap.writer import Writer
    with path.open('wb') as stream:
        writer = Writer(stream)
        writer.start('ros2', 'hostile')
        schema = writer.register_schema(f'std_msgs/msg/{FORGED}', 'ros2msg', b'')
        writer.add_message(writer.register_channel(topic, 'cdr', schema), 1, b'', 1)
        writer.finish()


ATTACKS = [
    *LEFT,
    Attack('SIGKILL while it saves', 20, 1, kills_while_saving),
    Attack('service calls', 500, 25, service_calls),
    Attack('types of parameters', 512, 16, parameter_types),
    Attack('invalid transitions', 256, 16, transitions),
    Attack('odd raw images', 41, 8, odd_images(Image, odd_image)),
    Attack('odd compressed images', 48, 12, odd_images(CompressedImage, compressed_odd)),
    Attack('damaged images of another size', 20, 3, other_sizes),
    Attack('camera_info for a checker', 17, 17, camera_infos),
    Attack('stamps of frames', 8, 8, frames),
    Attack('calibration files', 127, 127, calibration_files),
    Attack('stored turns', 25, 25, stores),
    Attack('manifests', 40, 5, manifests),
    Attack('SIGKILL of a batch', 10, 1, batch_kills),
    Attack('SIGKILL of children that calibrate', 10, 1, child_kills),
    Attack('Ctrl-C at any line', 100, 4, interrupts),
    Attack('a FIFO for a file', 11, 11, pipes),
    Attack('clips of scenes', 40, 6, scene_files),
    Attack('two cameras on one stream', 26, 4, two_cameras),
    Attack('two publishers', 20, 3, two_publishers),
    Attack('pictures that take long', 20, 5, slow_pictures),
    Attack('SIGHUP', 20, 2, hangups),
    Attack('a clock that jumps', 40, 5, jumping_clock),
    Attack('odd parameters at the start', 120, 8, odd_parameters),
    Attack('small files that become large', 16, 16, bombs),
    Attack('numbers that no lens has', 18, 3, numbers),
    Attack('names that act', 8, 8, forged_texts)]


def tried(attack: Attack, lacking: Sequence[int]) -> Iterator[tuple[int, str]]:
    """Try an attack; yield each number with why it did not hold, '' where it did."""
    rest = list(lacking)
    while rest:
        with TemporaryDirectory(prefix='hostile-', ignore_cleanup_errors=True) as folder:
            try:
                for _ in attack.run(Path(folder), list(rest)):
                    yield rest.pop(0), ''
                return
            except Exception as error:
                said = f'{type(error).__name__}: {error}'[:500]
            if rest:
                yield rest.pop(0), said


def summary(rows: Sequence[dict[str, Any]]) -> str:
    """Return a line for each attack, also where it was not tried."""
    lines = []
    for attack in ATTACKS:
        own = [row for row in rows if row['attack'] == attack.name]
        bad = [row for row in own if row['said']]
        lines.append([attack.name, f'{len(own) - len(bad)} of {len(own)}' if own else 'not tried',
                      ' '.join(f'try {bad[0]["try"]}: {bad[0]["said"]}'.split())[:200]
                      if bad else ''])
    held = sum(cells[1] != 'not tried' and not cells[2] for cells in lines)
    return f'{held} of {len(lines)} attacks held.\n\n' + table(
        ['attack', 'held', 'the first that did not'], lines)


def main() -> None:
    parser = parser_with(__doc__, 'again')
    parser.add_argument('attacks', nargs='*', help='parts of names; default: all')
    parser.add_argument('--quick', action='store_true', help='a few tries of each')
    parser.add_argument('--list', action='store_true', help='name the attacks, and end')
    options = parser.parse_args()
    if options.list:
        print('\n'.join(attack.name for attack in ATTACKS))
        return
    path = options.out / 'hostile.jsonl'
    path.parent.mkdir(parents=True, exist_ok=True)
    chosen = [attack for attack in ATTACKS
              if not options.attacks or any(part in attack.name for part in options.attacks)]
    anew = {attack.name for attack in chosen} if options.again else set()
    rows = {(row['attack'], row['try']): row for row in map(json.loads, (
        path.read_text().splitlines() if path.exists() else ())) if row['attack'] not in anew}
    with path.open('w') as stream:
        stream.writelines(json.dumps(row) + '\n' for row in rows.values())
        stream.flush()
        for attack in chosen:
            count = attack.quick if options.quick else attack.tries
            # one that did not hold is tried again
            lacking = [n for n in range(count)
                       if rows.get((attack.name, n), {'said': 'never tried'})['said']]
            for n, said in tried(attack, lacking):
                row = {'attack': attack.name, 'try': n, 'said': said, 'commit': commit()}
                rows[attack.name, n] = row
                stream.write(json.dumps(row) + '\n')
                stream.flush()
                if said:
                    print(f'{attack.name}, try {n}: {said}', file=sys.stderr, flush=True)
            print(f'{attack.name}: {count}', flush=True)
    keep_table('hostile', summary(list(rows.values())), options,
               [row['commit'] for row in rows.values()])


if __name__ == '__main__':
    main()
