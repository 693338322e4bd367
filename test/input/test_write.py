"""Frames that are written as a bag."""
from __future__ import annotations

import numpy as np
import pytest
from made_drives import (
    START,
    STEP,
    drive,
    smooth,
)

from dashcalib_ros.errors import OutputError
from dashcalib_ros.input import Frame
from dashcalib_ros.input.bag_write import BagWriter
from dashcalib_ros.input.inputs import open_frames


@pytest.mark.parametrize('compressed, tolerance', [(None, 0), ('png', 0), ('jpeg', 6)])
def test_what_is_written_reads_the_same(tmp_path, compressed, tolerance):
    frames = [Frame(frame.index, START + frame.index * STEP + 7, frame.image)
              for frame in smooth()]
    with BagWriter(tmp_path / 'new' / 'bag', '/cam', 'dash', compressed, 95) as writer:
        for frame in frames:
            writer.write(frame)
    assert sorted(file.name for file in (tmp_path / 'new').rglob('*')) == [
        'bag', 'bag.mcap', 'metadata.yaml']
    source = open_frames(tmp_path / 'new' / 'bag')
    assert (source.topic, source.count) == ('/cam', 12)
    for one, other in zip(source, frames, strict=True):
        assert one.stamp_ns == other.stamp_ns
        assert np.abs(one.image.astype(int) - other.image).max() <= tolerance
    assert source.warnings == ()


def test_nothing_half_written_is_left(tmp_path):
    with pytest.raises(KeyboardInterrupt), BagWriter(tmp_path / 'bag', '/cam') as writer:
        writer.write(drive(1)[0])
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_a_bag_is_never_overwritten(tmp_path):
    (tmp_path / 'bag').mkdir()
    with pytest.raises(OutputError, match='exists'), BagWriter(tmp_path / 'bag', '/cam'):
        pass
    (tmp_path / 'file').touch()
    with (pytest.raises(OutputError, match='cannot be written'),
          BagWriter(tmp_path / 'file' / 'bag', '/cam')):
        pass
    with pytest.raises(OutputError, match='jpeg, png or None'):
        BagWriter(tmp_path / 'new', '/cam', compressed='gif')
    assert sorted(each.name for each in tmp_path.iterdir()) == ['bag', 'file']
