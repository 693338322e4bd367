# SPDX-License-Identifier: Apache-2.0
"""Bags of every kind come in as the same frames; of broken ones comes what is left."""
from __future__ import annotations

import os
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import zstandard
from made_drives import (
    IMAGE,
    START,
    STEP,
    cut,
    drive,
    fails,
    image,
    images,
    picture,
    same,
    split_bag,
    storage,
    suffix,
    text,
    write_bag,
    write_mcap,
    write_ros1,
)
from mcap.writer import CompressionType, IndexType
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from dashcalib_ros.input.inputs import open_frames

KITTI = Path(__file__).parents[3] / 'shared' / 'data' / 'kitti03' / 'bag'


@pytest.mark.parametrize('plugin', StoragePlugin)
@pytest.mark.parametrize('mode', [CompressionMode.NONE, CompressionMode.FILE,
                                  CompressionMode.MESSAGE, CompressionMode.STORAGE])
def test_ros2_bags(tmp_path, plugin, mode):
    if (plugin, mode) == (StoragePlugin.SQLITE3, CompressionMode.STORAGE):
        mode = CompressionMode.NONE  # SQLite has no such thing
    frames = drive()
    bag = write_bag(tmp_path / 'bag', images(frames), plugin, mode)
    for path in (bag, storage(bag)):
        source = open_frames(path)
        assert (source.name, source.count, source.topic) == (str(path), 20, '/camera')
        same(list(source), frames)
        same(list(source), frames)
        assert source.warnings == ()


@pytest.mark.parametrize('compression', [None, *Writer1.CompressionFormat])
@pytest.mark.parametrize('compressed', [False, True])
def test_ros1_bags(tmp_path, compression, compressed):
    frames = drive()
    source = open_frames(write_ros1(tmp_path / 'drive.bag', frames, compression, compressed))
    assert (source.count, source.topic) == (20, '/camera')
    same(list(source), frames)
    assert source.warnings == ()


@pytest.mark.parametrize('options', [
    {'index_types': IndexType.NONE, 'use_chunking': False, 'use_statistics': False,
     'use_summary_offsets': False, 'repeat_channels': False, 'repeat_schemas': False},
    {'index_types': IndexType.NONE, 'use_statistics': False, 'use_summary_offsets': False,
     'repeat_channels': False, 'repeat_schemas': False},
    {'index_types': IndexType.CHUNK},
    {'compression': CompressionType.LZ4, 'chunk_size': 5000},
    {'profile': ''}])
def test_mcap_files_with_less_than_a_full_index(tmp_path, options):
    frames = drive()
    source = open_frames(write_mcap(tmp_path / 'drive.mcap', frames, **options))
    assert source.count == 20
    same(list(source), frames)
    assert source.warnings == ()


def test_frames_of_a_bag_tell_their_camera(tmp_path):
    """A turn that is stored knows by this of which camera it is."""
    bag = write_bag(tmp_path / 'bag', images(drive(3)))
    assert [frame.frame_id for frame in open_frames(bag)] == ['camera'] * 3


def test_a_split_bag_is_one_drive(tmp_path):
    frames = drive(30)
    bag = split_bag(tmp_path, frames)
    source = open_frames(bag)
    assert source.count == 30
    same(list(source), frames)
    assert source.warnings == ()
    (bag / 'metadata.yaml').unlink()
    source = open_frames(bag)
    assert source.count == 30
    same(list(source), frames)  # 2.mcap before 10.mcap
    assert source.warnings[0].code == 'E-BAG-NO-METADATA'


@pytest.mark.parametrize('plugin', StoragePlugin)
@pytest.mark.parametrize(
    'metadata', [None, '', '][', 'a: 1', '\0', 'rosbag2_bagfile_information:'])
def test_a_lost_or_broken_metadata_file_is_no_obstacle(tmp_path, plugin, metadata):
    frames = drive(5)
    bag = write_bag(tmp_path / 'bag', images(frames), plugin)
    (bag / 'metadata.yaml').unlink()
    if metadata is not None:
        (bag / 'metadata.yaml').write_text(metadata)
    source = open_frames(bag)
    same(list(source), frames)
    [warning] = source.warnings
    assert warning.code == 'E-BAG-NO-METADATA'
    assert str(bag) in str(warning) and f'bag.{suffix(plugin)}' in str(warning)


@pytest.mark.parametrize('plugin', StoragePlugin)
def test_a_path_with_odd_characters(tmp_path, plugin):
    frames = drive(5)
    bag = write_bag(tmp_path / 'bag', images(frames), plugin)
    same(list(open_frames(bag.rename(tmp_path / 'a b?#%20ü'))), frames)


@pytest.mark.parametrize('plugin', StoragePlugin)
def test_memory_does_not_grow_with_the_drive(tmp_path, plugin):
    def peak(count):
        source = open_frames(
            write_bag(tmp_path / str(count), images(drive(count, 320, 240)), plugin))
        assert sum(1 for _ in source) == count  # also loads what is loaded only once
        tracemalloc.start()
        for _ in source:
            pass
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return most

    assert peak(150) < 1.2 * peak(50)  # of 11.5 and 3.8 MB


@pytest.mark.skipif(not KITTI.exists(), reason=f'no real drive at {KITTI}')
def test_a_real_drive():
    source = open_frames(KITTI)
    assert (source.count, source.topic) == (801, '/camera/image_raw/compressed')
    count = 0
    for frame in source:
        assert (frame.index, frame.size) == (count, (1242, 375))
        count += 1
    assert count == 801
    assert frame.stamp_ns - START == 80 * 10**9
    assert source.warnings == ()


def two_cameras(tmp_path):
    frames = drive(4)
    other = drive(3, 32, 24)
    return write_bag(tmp_path / 'bag', [
        *images(frames, '/left'),
        *[('/right/compressed', frame.stamp_ns, picture(frame)) for frame in other],
        ('/words', START, text('hello'))])


def test_several_image_topics_are_listed(tmp_path):
    line = fails('E-BAG-TOPIC-AMBIGUOUS', two_cameras(tmp_path), '2 image topics', '--topic',
                 '/left (Image, 4 images)', '/right/compressed (CompressedImage, 3 images)')
    assert '/words' not in line


@pytest.mark.parametrize('topic', ['/left', 'left'])
def test_a_chosen_topic_is_read_alone(tmp_path, topic):
    source = open_frames(two_cameras(tmp_path), topic=topic)
    assert (source.topic, source.count) == ('/left', 4)
    same(list(source), drive(4))


@pytest.mark.parametrize('topic', ['/middle', '/words'])
def test_a_wrong_topic_lists_what_there_is(tmp_path, topic):
    fails('E-BAG-TOPIC-UNKNOWN', two_cameras(tmp_path), repr(topic), '/left (Image',
          '/right/compressed (', topic=topic)


def test_topics_that_do_not_count(tmp_path):
    frames = drive(4)
    bag = write_bag(
        tmp_path / 'bag',
        [*images(frames), ('/words', START, text('hello')),
         ('/camera/compressedDepth', START, picture(frames[0], '16UC1; compressedDepth'))],
        empty=[('/unused', IMAGE)])
    same(list(open_frames(bag)), frames)


def test_no_image_topic(tmp_path):
    words = write_bag(tmp_path / 'words', [('/words', START, text('hello'))])
    fails('E-BAG-NO-IMAGES', words, '/words (std_msgs/msg/String)')
    nothing = write_bag(tmp_path / 'nothing', [])
    fails('E-BAG-NO-IMAGES', nothing, 'no messages')
    unused = write_bag(tmp_path / 'unused', [('/words', START, text('hello'))],
                       empty=[('/camera', IMAGE)])
    fails('E-BAG-TOPIC-EMPTY', unused, '/camera')


def test_without_header_stamps_the_times_of_reception_count(tmp_path):
    frames = drive(5)
    source = open_frames(write_bag(tmp_path / 'bag', [
        ('/camera', frame.stamp_ns, image(frame, stamp_ns=0)) for frame in frames]))
    same(list(source), frames)
    assert [each.code for each in source.warnings] == ['E-STAMP-MISSING']


def test_images_that_come_twice_or_late_are_skipped(tmp_path):
    frames = drive(6)
    stamps = [0, 1, 1, 3, 2, 5]
    source = open_frames(write_bag(tmp_path / 'bag', [
        ('/camera', frame.stamp_ns, image(frame, stamp_ns=START + stamp * STEP))
        for frame, stamp in zip(frames, stamps, strict=True)]))
    found = list(source)
    assert [frame.index for frame in found] == [0, 1, 3, 5]
    assert [(frame.stamp_ns - START) // STEP for frame in found] == [0, 1, 3, 5]
    assert source.warnings[0].code == 'E-STAMP-NOT-LATER'
    assert '2 images skipped' in str(source.warnings[0])


@pytest.mark.parametrize('plugin', StoragePlugin)
@pytest.mark.parametrize('share', [0.4, 0.8, 0.999])
def test_a_cut_ros2_bag_gives_what_precedes_the_cut(tmp_path, plugin, share):
    frames = drive(60, 320, 240)  # 4.6 MB: several chunks
    bag = write_bag(tmp_path / 'bag', images(frames), plugin)
    file = cut(storage(bag), share)
    source = open_frames(bag)
    found = list(source)
    assert source.count == 60
    assert 60 * share - 18 <= len(found) <= 60  # a chunk has 14 images
    same(found, frames[:len(found)])
    warning, = source.warnings
    assert f'{len(found)} of 60 images were read, ' in str(warning)
    assert ('none is lost' if len(found) == 60 else f'{60 - len(found)} are lost') in str(warning)

    alone = open_frames(file)
    same(list(alone), found)
    assert f'{len(found)} images were read, the number of lost images' in str(alone.warnings[0])


@pytest.mark.parametrize('compression', [None, *Writer1.CompressionFormat])
@pytest.mark.parametrize('share', [0.4, 0.8, 0.9995])
def test_a_cut_ros1_bag_gives_what_precedes_the_cut(tmp_path, compression, share):
    frames = drive(60, 320, 240)
    source = open_frames(
        cut(write_ros1(tmp_path / 'drive.bag', frames, compression), share))
    found = list(source)
    assert 60 * share - 18 <= len(found) <= 60
    same(found, frames[:len(found)])
    assert f'{len(found)} images were read, the number of lost images' in str(source.warnings[0])


@pytest.mark.parametrize('plugin', StoragePlugin)
@pytest.mark.parametrize('alone', [False, True])
def test_a_cut_zstd_file(tmp_path, plugin, alone):
    frames = drive(60, 320, 240)
    bag = write_bag(tmp_path / 'bag', images(frames), plugin, CompressionMode.FILE)
    file = cut(storage(bag), 0.6)
    source = open_frames(file if alone else bag)
    found = list(source)
    assert 60 * 0.6 - 18 <= len(found) < 60
    same(found, frames[:len(found)])
    assert f': {len(found)} ' in str(source.warnings[0])


def test_a_broken_chunk_costs_only_itself(tmp_path):
    frames = drive(60)
    file = write_mcap(tmp_path / 'drive.mcap', frames, chunk_size=20_000)  # 7 images a chunk
    data = bytearray(file.read_bytes())
    middle = len(data) // 2
    data[middle:middle + 50] = bytes(50)
    file.write_bytes(data)
    source = open_frames(file)
    found = list(source)
    assert 50 <= len(found) <= 55
    expected = {frame.stamp_ns: frame for frame in frames}
    for frame in found:
        np.testing.assert_array_equal(frame.image, expected[frame.stamp_ns].image)
    assert found[-1].stamp_ns == frames[-1].stamp_ns
    assert (f'{len(found)} of 60 images were read, {60 - len(found)} are lost'
            in str(source.warnings[0]))
    assert 'damaged chunk' in str(source.warnings[0])


def test_a_broken_first_chunk_costs_only_itself(tmp_path):
    """It has the names of the topics, which the end of the file repeats."""
    frames = drive(60)
    file = write_mcap(tmp_path / 'drive.mcap', frames, chunk_size=20_000)
    data = bytearray(file.read_bytes())
    data[1000:1050] = bytes(50)
    file.write_bytes(data)
    source = open_frames(file)
    found = list(source)
    assert [frame.stamp_ns for frame in found] == [
        frame.stamp_ns for frame in frames[60 - len(found):]]
    assert 50 <= len(found) <= 55
    assert (f'{len(found)} of 60 images were read, {60 - len(found)} are lost'
            in str(source.warnings[0]))


def test_a_split_bag_with_a_missing_and_a_broken_file(tmp_path):
    frames = drive(30)
    bag = split_bag(tmp_path, frames)
    (bag / '2.mcap').write_bytes(os.urandom(1000))
    source = open_frames(bag)
    assert len(list(source)) == 20
    assert '20 of 30 images were read, 10 are lost' in str(source.warnings[0])
    (bag / '2.mcap').unlink()
    source = open_frames(bag)
    assert [frame.stamp_ns for frame in source] == [
        frame.stamp_ns for frame in frames[:10] + frames[20:]]
    assert [each.code for each in source.warnings] == ['E-BAG-FILE-MISSING', 'E-BAG-IMAGES-LOST']
    assert '2.mcap' in str(source.warnings[0])
    assert '20 of 30 images were read, 10 are lost' in str(source.warnings[1])


@pytest.mark.parametrize('plugin', StoragePlugin)
def test_a_bag_folder_of_junk(tmp_path, plugin):
    bag = write_bag(tmp_path / 'bag', images(drive(5)), plugin)
    storage(bag).write_bytes(b'junk' * 100)
    fails('E-INPUT-NO-IMAGES', bag, bag, '0 of 5 images were read, 5 are lost', 'ros2 bag reindex')


def test_a_single_zstd_file_of_the_zstd_tool(tmp_path):
    frames = drive(5)
    plain = write_mcap(tmp_path / 'drive.mcap', frames)
    packed = tmp_path / 'drive.mcap.zstd'
    packed.write_bytes(zstandard.compress(plain.read_bytes()))
    plain.unlink()
    same(list(open_frames(packed)), frames)
