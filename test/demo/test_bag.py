# SPDX-License-Identifier: Apache-2.0
"""A rendered drive as a bag."""
from __future__ import annotations

from unittest.mock import create_autospec

import pytest
from made_drives import drive, same

from dashcalib_ros.demo import Drive, render_to_bag
from dashcalib_ros.input.inputs import open_frames


@pytest.fixture
def rendered():
    found = create_autospec(Drive, instance=True)
    found.frames.return_value = drive()
    found.__len__.return_value = 20
    return found


def test_the_bag_has_the_frames_of_the_drive(rendered, tmp_path):
    path = tmp_path / 'new' / 'bag'
    told = []
    render_to_bag(rendered, path, told.append)
    assert told == [n / 20 for n in range(1, 21)]
    assert sorted(file.name for file in path.parent.rglob('*')) == [
        'bag', 'bag.mcap', 'metadata.yaml']
    source = open_frames(path)
    assert (source.topic, source.count) == ('/camera/image_raw', 20)
    same(list(source), drive())
    assert source.warnings == ()


def test_nothing_half_written_is_left(rendered, tmp_path):
    def interrupted(processes):
        yield from drive(3)
        raise KeyboardInterrupt
    rendered.frames.side_effect = interrupted
    with pytest.raises(KeyboardInterrupt):
        render_to_bag(rendered, tmp_path / 'bag')
    assert list(tmp_path.iterdir()) == []
