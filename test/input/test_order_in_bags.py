# SPDX-License-Identifier: Apache-2.0
"""Messages in any order, in any file, with any part of an index: all by time, none lost."""
from __future__ import annotations

import random
import shutil
import sqlite3

import pytest
import yaml
from made_drives import (
    COMPRESSED,
    ROS2,
    drive,
    fails,
    image,
    images,
    picture,
    same,
    storage,
    write_bag,
    write_mcap,
    write_ros1,
)
from mcap.writer import IndexType, Writer
from refused import refused
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionMode, Reader, StoragePlugin

from dashcalib_ros.camera import Radial
from dashcalib_ros.errors import InputError
from dashcalib_ros.input import bag_write
from dashcalib_ros.input.inputs import open_frames

FRAMES = drive(40)
LENS = Radial((64, 48), 50.0, 51.0, 31.0, 23.0, -0.1, 0.01)
NOTHING = {'index_types': IndexType.NONE, 'use_statistics': False, 'use_summary_offsets': False,
           'repeat_channels': False, 'repeat_schemas': False}


def shuffled(frames, far=None):
    """Return frames in another order: each moved by up to `far` places; None: anywhere."""
    places = random.Random(3)
    return sorted(frames, key=lambda frame: places.random() * 40 if far is None else
                  frame.index + places.uniform(0, far))


def whole(source, frames=FRAMES):
    same(list(source), frames)
    assert source.warnings == ()


@pytest.mark.parametrize('far', [2, 5, None])
@pytest.mark.parametrize('options', [
    {'use_chunking': False}, {'use_chunking': False, **NOTHING}, {'chunk_size': 9000},
    {'chunk_size': 9000, **NOTHING}, {'chunk_size': 9000, 'index_types': IndexType.CHUNK},
    {'chunk_size': 9000, 'profile': ''}])
def test_messages_of_an_mcap_file_come_by_time(tmp_path, far, options):
    file = write_mcap(tmp_path / 'drive.mcap', shuffled(FRAMES, far), **options)
    source = open_frames(file)
    assert source.count == 40
    whole(source)


@pytest.mark.parametrize('plugin', StoragePlugin)
def test_messages_of_a_bag_come_by_time(tmp_path, plugin):
    bag = write_bag(tmp_path / 'bag', images(shuffled(FRAMES)), plugin)
    whole(open_frames(bag))
    whole(open_frames(storage(bag)))


def test_messages_of_a_ros1_bag_come_by_time(tmp_path):
    frames = drive(400)
    whole(open_frames(write_ros1(tmp_path / 'drive.bag', shuffled(frames),
                                 Writer1.CompressionFormat.BZ2)), frames)


class PartlyIndexed(Writer):
    """A writer of every second chunk without an index of its messages."""

    def add_message(self, *args, **options):
        super().add_message(*args, **options)
        chunks = len(self._Writer__chunk_indices)
        self._Writer__index_types = IndexType.ALL if chunks % 2 else (
            IndexType.ALL & ~IndexType.MESSAGE)


def partly_indexed(path, frames, monkeypatch, **options):
    with monkeypatch.context() as patch:
        patch.setattr('made_drives.McapWriter', PartlyIndexed)
        return write_mcap(path, frames, chunk_size=9000, **options)


@pytest.mark.parametrize('far', [0, 5])
@pytest.mark.parametrize('options', [{}, {'use_statistics': False}])
def test_chunks_without_an_index_of_messages_are_whole(tmp_path, far, options, monkeypatch):
    file = partly_indexed(tmp_path / 'drive.mcap', shuffled(FRAMES, far), monkeypatch, **options)
    source = open_frames(file)
    assert source.count == 40
    whole(source)


def test_a_copy_of_a_bag_with_such_chunks_has_all_images(tmp_path, monkeypatch):
    file = partly_indexed(tmp_path / 'drive.mcap', FRAMES, monkeypatch)
    assert bag_write.write_bag(file, '/camera', LENS, tmp_path / 'out') == 40
    with Reader(tmp_path / 'out') as reader:
        assert {each.topic: each.msgcount for each in reader.connections} == {
            '/camera': 40, '/camera_info': 40}


@pytest.mark.parametrize('change', [-9, -1, 1, 40])
def test_an_index_that_is_wrong_loses_nothing(tmp_path, change, monkeypatch):
    """The places of chunks are wrong, or those of one chunk only."""
    class Wrong(Writer):
        def finish(self):
            self._Writer__finalize_chunk()
            for index in self._Writer__chunk_indices[1::2]:
                index.chunk_start_offset += change
            super().finish()
    with monkeypatch.context() as patch:
        patch.setattr('made_drives.McapWriter', Wrong)
        file = write_mcap(tmp_path / 'drive.mcap', FRAMES, chunk_size=9000)
    whole(open_frames(file))


def test_chunks_that_the_index_leaves_out_are_read(tmp_path, monkeypatch):
    class Few(Writer):
        def finish(self):
            self._Writer__finalize_chunk()
            del self._Writer__chunk_indices[1::2]
            super().finish()
    with monkeypatch.context() as patch:
        patch.setattr('made_drives.McapWriter', Few)
        file = write_mcap(tmp_path / 'drive.mcap', shuffled(FRAMES, 3), chunk_size=9000)
    whole(open_frames(file))


def split(tmp_path, parts, plugin=StoragePlugin.MCAP, mode=CompressionMode.NONE, metadata=True):
    """Write a bag of one file for each of these frames."""
    bag = tmp_path / 'split'
    bag.mkdir()
    for n, part in enumerate(parts):
        one = write_bag(tmp_path / str(n), images(part), plugin, mode)
        file = storage(one)
        shutil.move(file, bag / f'b_{n}{"".join(file.suffixes)}')
    about = yaml.safe_load((one / 'metadata.yaml').read_text())
    content = about['rosbag2_bagfile_information']
    content['relative_file_paths'] = sorted(file.name for file in bag.iterdir())
    content['topics_with_message_count'][0]['message_count'] = sum(map(len, parts))
    del content['files']
    if metadata:
        (bag / 'metadata.yaml').write_text(yaml.safe_dump(about))
    return bag


@pytest.mark.parametrize('plugin', StoragePlugin)
@pytest.mark.parametrize('mode', [CompressionMode.NONE, CompressionMode.FILE])
def test_files_of_a_bag_are_joined_by_time(tmp_path, plugin, mode):
    later_first = (FRAMES[25:], FRAMES[:10], FRAMES[10:25])
    whole(open_frames(split(tmp_path, later_first, plugin, mode)))


@pytest.mark.parametrize('plugin', StoragePlugin)
def test_files_that_overlap_are_merged(tmp_path, plugin):
    ends = [*FRAMES[:15], *FRAMES[16:24:2]], [*FRAMES[15:23:2], *FRAMES[23:]]
    assert sorted(frame.index for part in ends for frame in part) == list(range(40))
    bag = split(tmp_path, ends, plugin)
    whole(open_frames(bag))
    # its files alone, in any order
    files = sorted(file for file in bag.iterdir() if file.name.startswith('b_'))
    for some in (files, files[::-1], str(bag / 'b_*')):
        same(list(open_frames(some)), FRAMES)
    (bag / 'metadata.yaml').unlink()
    same(list(open_frames(bag)), FRAMES)


def test_messages_of_one_time_are_all_read_from_a_damaged_database(tmp_path):
    frames = FRAMES[:6]
    bag = write_bag(tmp_path / 'bag', [
        (topic, frame.stamp_ns, image(frame)) for frame in frames for topic in ('/left', '/right')
    ], StoragePlugin.SQLITE3)
    with sqlite3.connect(storage(bag)) as database:
        # what rosbags wants, and no one needs
        database.execute("UPDATE topics SET offered_qos_profiles = '['")
        database.execute('UPDATE messages SET id = 100 - id')
    (bag / 'metadata.yaml').unlink()
    same(list(open_frames(bag, topic='/left')), frames)


def test_a_database_of_an_old_recorder(tmp_path):
    """It has neither a schema nor definitions of messages."""
    bag = write_bag(tmp_path / 'bag', images(shuffled(FRAMES)), StoragePlugin.SQLITE3)
    with sqlite3.connect(storage(bag)) as database:
        for table in ('schema', 'metadata', 'message_definitions'):
            database.execute(f'DROP TABLE {table}')
        database.execute('DROP INDEX timestamp_idx')
    whole(open_frames(bag))
    whole(open_frames(storage(bag)))


def without_type(path):
    """Write an MCAP bag as the first plugin did: no schema."""
    with path.open('wb') as file:
        writer = Writer(file)
        writer.start('ros2', 'test')
        channel = writer.register_channel('/camera/compressed', 'cdr', 0)
        for frame in FRAMES:
            writer.add_message(channel, frame.stamp_ns, bytes(
                ROS2.serialize_cdr(picture(frame), COMPRESSED)), frame.stamp_ns)
        writer.finish()
    return path


def test_the_type_of_a_topic_is_that_of_metadata(tmp_path):
    file = without_type(tmp_path / 'drive.mcap')
    fails('E-BAG-TYPE-MISSING', file, '/camera/compressed', 'metadata.yaml')
    bag = write_bag(tmp_path / 'bag', [
        ('/camera/compressed', frame.stamp_ns, picture(frame)) for frame in FRAMES])
    shutil.move(file, storage(bag))
    whole(open_frames(bag))
    whole(open_frames(storage(bag)))
    with refused(InputError, 'E-BAG-DAMAGED', 'type'):
        bag_write.check_bag(bag, '/camera/compressed', tmp_path / 'out')


def test_the_type_of_a_topic_is_missing_in_a_database(tmp_path):
    bag = write_bag(tmp_path / 'bag', images(FRAMES), StoragePlugin.SQLITE3)
    with sqlite3.connect(storage(bag)) as database:
        database.execute("UPDATE topics SET type = ''")
    whole(open_frames(bag))
    shutil.move(storage(bag), tmp_path / 'alone.db3')
    fails('E-BAG-TYPE-MISSING', tmp_path / 'alone.db3', '/camera')


def test_several_broken_files_are_all_named(tmp_path):
    bag = split(tmp_path, (FRAMES[:5], FRAMES[5:10], FRAMES[10:]), metadata=False)
    for n in range(3):
        (bag / f'b_{n}.mcap').write_bytes(b'\x89MCAP0\r\n' + bytes(40))
    fails('E-BAG-DAMAGED', bag, 'b_0.mcap', 'b_1.mcap', 'b_2.mcap')


@pytest.mark.parametrize(('topic', 'name', 'code', 'value'), [
    ('/camera/compressedDepth', '16UC1; compressedDepth', 'E-IMAGE-DEPTH', '/camera'),
    ('/camera/jxl', 'jxl', 'E-IMAGE-FORMAT', 'jxl'),
    ('/camera/compressed', 'jpeg', 'E-IMAGE-DAMAGED', 'jpeg')])
def test_what_cannot_be_read_is_named(tmp_path, topic, name, code, value):
    message = picture(FRAMES[0], name)
    message.data[:20] = 7
    fails(code, write_bag(tmp_path / 'bag', [(topic, FRAMES[0].stamp_ns, message)]), value)


def test_images_in_another_transport_are_named(tmp_path):
    file = write_mcap(tmp_path / 'drive.mcap', FRAMES)
    name = b'theora_image_transport/msg/Packet'
    with file.open('wb') as stream:
        writer = Writer(stream)
        writer.start('ros2', 'test')
        channel = writer.register_channel('/camera/theora', 'cdr', writer.register_schema(
            name.decode(), 'ros2msg', b''))
        writer.add_message(channel, 1, bytes(8), 1)
        writer.finish()
    fails('E-BAG-TRANSPORT', file, 'in_transport:=theora', '-r in/theora:=/camera/theora',
          '/camera/compressed')
