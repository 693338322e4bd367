# SPDX-License-Identifier: Apache-2.0
"""What the tests have done in a child process; it must be importable there by name."""
from __future__ import annotations

import ctypes
import os
import sys
import threading
import time
from pathlib import Path

import numpy as np

from dashcalib_ros.camera import Radial
from dashcalib_ros.errors import InputError
from dashcalib_ros.problem.observations import Tracks
from dashcalib_ros.reconstruct.scene import Draft, Profile, Start


class AwkwardError(Exception):
    """Pickles, but cannot be made again from what was pickled."""

    def __init__(self, part, whole):
        super().__init__(f'{part} of {whole}')


def add(a, b):
    return a + b


def _tell(path):
    """Write this process's id; who sees the file may read it."""
    new = Path(f'{path}.new')
    new.write_text(str(os.getpid()))
    new.rename(path)


def pid():
    return os.getpid()


def niceness():
    return os.nice(0)


def threads():
    import cv2
    return cv2.getNumThreads()


def sleep(seconds, started=None):
    if started is not None:
        _tell(started)
    time.sleep(seconds)
    return 'slept'


def until(flag, started):
    """Write this process's id, and wait for a file."""
    _tell(started)
    while not Path(flag).exists():
        time.sleep(0.01)
    return 'seen'


def compute(seconds):
    """Use the processor for so long."""
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass
    return 'computed'


def echo(value):
    return value


def fail(kind):
    raise {'input': InputError('E-NO-TURN', 'drive one'), 'os': FileNotFoundError(2, 'gone'),
           'eof': EOFError('end'), 'value': ValueError('odd'), 'awkward': AwkwardError(1, 2),
           'local': type('LocalError', (Exception,), {})('made here')}[kind]


def count(steps, progress):
    for n in range(steps):
        progress(f'step {n}', n / steps)
    return steps


def unpicklable():
    return threading.Lock()


def print_much():
    print('this is not an answer' * 1000, flush=True)
    sys.stdout.write('nor this')
    ctypes.CDLL(None).puts(b'nor what a C library prints')
    ctypes.CDLL(None).fflush(None)
    os.write(1, b'nor this' * 100)
    return 'answer'


def die(code=1):
    os._exit(code)


def abort():
    os.abort()


def die_at_first(flag):
    """End this process the first time, answer the second time."""
    path = Path(flag)
    if not path.exists():
        path.write_text('been here')
        os._exit(9)
    return 'second time'


# stand-ins for reconstruct.draft(turn, config, valid)

def build_dies(turn, config, valid):
    """Note the turn in a file, and end this process, until there is another file."""
    if Path(f'{turn.frames[0]}.ended').exists():
        return build(turn, config, valid)
    with Path(turn.frames[0]).open('a') as log:
        log.write(f'{turn.center}\n')
    os._exit(1)


def build_dies_at_first(turn, config, valid):
    return die_at_first(f'{turn.frames[0]}.{turn.center}')


def build_slowly(turn, config, valid):
    _tell(f'{turn.frames[0]}.{turn.center}')
    time.sleep(60)


def build_hangs_at_first(turn, config, valid):
    if not Path(f'{turn.frames[0]}.{turn.center}').exists():
        build_slowly(turn, config, valid)
    return build(turn, config, valid)


def build_fails_at_first(turn, config, valid):
    path = Path(f'{turn.frames[0]}.{turn.center}')
    if not path.exists():
        path.write_text('been here')
        raise MemoryError('no room')
    return f'scene of {turn.center}'


def build(turn, config, valid):
    return f'scene of {turn.center}'


def draft(turn, config, valid):
    """Return a draft of every other image; frame_id tells where to write what was done."""
    noted(turn, f'draft of {turn.center}')
    frames = np.array([frame.index for frame in turn.frames[::2]])
    tracks = Tracks(frames, np.zeros((len(frames), 0, 2)), (64, 48), frames)
    return Draft(tracks, Start(Profile(np.ones(1), np.ones(1), 1), Radial.centred((64, 48), 50.0)))


# stand-ins for reconstruct.finish(turn, config, begun)

def finish(turn, config, begun):
    noted(turn, f'scene of {turn.center}')
    assert begun.start.camera.fx == 50.0
    return [frame.index for frame in turn.frames]


def finish_dies_at_first(turn, config, begun):
    die_at_first(f'{turn.frames[0].frame_id}.{turn.center}')
    return finish(turn, config, begun)


def noted(turn, text):
    with Path(turn.frames[0].frame_id).open('a') as log:
        log.write(f'{text}\n')
