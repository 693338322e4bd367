# SPDX-License-Identifier: Apache-2.0
"""Drives of any damage, and of any parts: nothing is lost without a word, nothing is made up."""
from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_drives import (
    drive,
    images,
    smooth,
    storage,
    write_bag,
    write_folder,
    write_mcap,
    write_ros1,
    write_video,
)
from mcap.writer import CompressionType
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from dashcalib_ros.errors import InputError
from dashcalib_ros.input import Frame
from dashcalib_ros.input.inputs import open_frames

COUNT = 24
MANY = settings(derandomize=True, deadline=None, max_examples=300, database=None)


@pytest.fixture(scope='module')
def bags(tmp_path_factory) -> dict[str, Path]:
    """Write the same drive as storage files of every kind."""
    place = tmp_path_factory.mktemp('bags')
    frames, messages = drive(COUNT), images(drive(COUNT))
    return {
        'mcap': storage(write_bag(place / 'mcap', messages)),
        'db3': storage(write_bag(place / 'db3', messages, StoragePlugin.SQLITE3)),
        'zstd': storage(write_bag(place / 'zstd', messages, mode=CompressionMode.FILE)),
        'message': storage(write_bag(place / 'each', messages, mode=CompressionMode.MESSAGE)),
        # seven chunks, each with a checksum
        'plain chunks': write_mcap(place / 'plain.mcap', frames, chunk_size=12_000,
                                   compression=CompressionType.NONE),
        'packed chunks': write_mcap(place / 'packed.mcap', frames, chunk_size=12_000),
        'ros1': write_ros1(place / 'plain.bag', frames),
        'packed ros1': write_ros1(place / 'packed.bag', frames, Writer1.CompressionFormat.LZ4)}


KINDS = ('mcap', 'db3', 'zstd', 'message', 'plain chunks', 'packed chunks', 'ros1', 'packed ros1')
# where a byte is changed: structures are at the start and at the end
PLACES = st.integers(0, 2000) | st.integers(-2000, -1) | st.integers(0, 2**17)
DAMAGE = st.lists(st.tuples(PLACES, st.integers(0, 255)), max_size=3)


@MANY
@given(st.sampled_from(KINDS), DAMAGE, st.floats(0.05, 1.0) | st.just(1.0))
def test_a_bag_of_any_damage(bags: dict[str, Path], kind: str, damage: list[tuple[int, int]],
                             share: float) -> None:
    data = bytearray(bags[kind].read_bytes())
    for place, value in damage:
        data[place % len(data)] = value
    path = bags[kind].with_name(f'damaged{"".join(bags[kind].suffixes)}')
    path.write_bytes(data[:int(share * len(data))])
    try:
        source = open_frames(path)
        found = list(source)
    except InputError as error:
        assert len(str(error).splitlines()) == 1
        return
    assert all(len(str(line).splitlines()) == 1 for line in source.warnings)
    stamps = [frame.stamp_ns for frame in found]
    assert stamps == sorted(set(stamps))
    indices = [frame.index for frame in found]
    assert indices == sorted(set(indices))
    assert source.count is not None
    assert source.warnings or len(found) == source.count
    if 'chunks' in kind and len(damage) < 2:
        written = {frame.stamp_ns: frame.image for frame in drive(COUNT)}
        assert all(np.array_equal(frame.image, written[frame.stamp_ns]) for frame in found)
    if not damage and share == 1.0:
        assert len(found) == COUNT and not source.warnings


@pytest.fixture(scope='module')
def parts(tmp_path_factory) -> list[Path]:
    """Write parts of drives: folders, bags that go on or not, a video."""
    place = tmp_path_factory.mktemp('parts')
    frames = drive(20)
    later = [Frame(frame.index, frame.stamp_ns + 10**11, frame.image) for frame in drive(4)]
    return [write_folder(place / 'five', frames[:5]), write_folder(place / 'one', frames[5:6]),
            write_bag(place / 'early', images(frames[6:13])),
            write_bag(place / 'on', images(frames[13:])), write_bag(place / 'late', images(later)),
            write_video(place / 'v.avi', smooth(6), fps=10)]


@pytest.mark.thorough
@MANY
@given(st.lists(st.integers(0, 5), min_size=1, max_size=4),
       st.floats(0.0, 3.0), st.none() | st.floats(0.05, 3.0))
def test_a_part_of_any_files_is_what_the_whole_has_there(
        parts: list[Path], order: list[int], start_s: float, duration_s: float | None) -> None:
    paths = [parts[each] for each in order]
    whole = list(open_frames(paths, fps=10))
    assert [frame.index for frame in whole] == list(range(len(whole)))
    stamps = [frame.stamp_ns for frame in whole]
    assert stamps == sorted(set(stamps))
    start_ns = round(start_s * 1e9)
    expected = [frame for frame in whole if frame.stamp_ns - stamps[0] >= start_ns]
    if duration_s is not None:
        expected = [frame for frame in expected
                    if frame.stamp_ns - expected[0].stamp_ns < round(duration_s * 1e9)]
    try:
        found = list(open_frames(paths, fps=10, start_s=start_s, duration_s=duration_s))
    except InputError as error:
        assert error.code == 'E-INPUT-START-LATE' and not expected
        return
    assert [(frame.index, frame.stamp_ns) for frame in found] == [
        (frame.index, frame.stamp_ns) for frame in expected]
    for one, other in zip(islice(found, 1, None), islice(expected, 1, None), strict=True):
        assert (one.after_gap, one.perhaps_after_gap) == (other.after_gap, other.perhaps_after_gap)
    for one, other in zip(found, expected, strict=True):
        assert np.array_equal(one.image, other.image)
