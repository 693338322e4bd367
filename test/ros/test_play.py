# SPDX-License-Identifier: Apache-2.0
"""examples/play.py: who has ROS 2 from pip feeds the node with it."""
from __future__ import annotations

import os
import subprocess
import sys

import pytest

pytest.importorskip('rclpy', reason='no ROS on this machine: pip install the ros extra')

from made_drives import drive, images, write_bag, write_video
from ros_bench import REPOSITORY, SOON, ros_environment

PLAY = REPOSITORY / 'examples' / 'play.py'


def play(home, *arguments):
    """Start it; strict about the fields of messages."""
    return subprocess.Popen([sys.executable, str(PLAY), *map(str, arguments)], text=True,
                            env={**os.environ, **ros_environment(home)},
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE)


@pytest.mark.parametrize('kind', ['video', 'bag'])
def test_the_node_gets_each_image_with_a_stamp(start_node, make_bench, tmp_path, kind):
    camera = make_bench(topic='elsewhere')
    if kind == 'video':
        path = tmp_path / 'drive.mp4'
        write_video(path, drive(20, 320, 240), codec='mp4v')
    else:
        path = tmp_path / 'drive'
        frames = drive(20, 320, 240)
        write_bag(path, [*images(frames, '/a/image_raw'), *images(frames, '/b/image_raw')])
    done = play(tmp_path, path, '--to', '/front/image_raw', '--speed', '2',
                *(['--topic', '/a/image_raw'] if kind == 'bag' else []))
    try:
        node = start_node('-r', 'image_raw:=/front/image_raw')
        camera.counted('received', 20, node)
        # as reliable as the node listens then, and with stamps that are believed
        camera.until(lambda: camera.values['reliability'] == 'reliable', node=node)
        assert camera.values['time stamps'] == 'of the images'
        assert camera.count('repeated') == camera.count('undecodable') == camera.count('lost') == 0
        assert 'are 320x240 in frame' in node.text
        assert done.wait(SOON) == 0, done.stderr.read()
        assert done.stdout.read().splitlines()[-1] == '20 images played'
    finally:
        done.kill()
        done.communicate()


def test_what_cannot_be_played_is_one_line(ros_context, tmp_path):
    done = play(tmp_path, tmp_path / 'missing.mp4')
    said, complained = done.communicate(timeout=SOON)
    assert done.returncode == 2 and said == ''
    assert len(complained.splitlines()) == 1 and 'missing.mp4' in complained
