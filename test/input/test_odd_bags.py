# SPDX-License-Identifier: Apache-2.0
"""Bags that are bombs, and folders of bags with odd entries in them."""
from __future__ import annotations

import bz2
import io
import os
import sqlite3

import lz4.frame
import made_drives
import pytest
import yaml
import zstandard
from made_drives import (
    ROS2,
    drive,
    fails,
    head,
    images,
    same,
    storage,
    write_bag,
    write_mcap,
    write_ros1,
)
from mcap.writer import CompressionType, IndexType
from refused import refused
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag1.reader import Header
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from dashcalib_ros.errors import InputError
from dashcalib_ros.input import bag_read
from dashcalib_ros.input.bag_read import unpack
from dashcalib_ros.input.bag_write import check_bag
from dashcalib_ros.input.inputs import open_frames

LAUGHS = 'a0: &a0 [lol, lol]\n' + '\n'.join(
    f'a{n}: &a{n} [{", ".join([f"*a{n - 1}"] * 10)}]' for n in range(1, 10))


@pytest.mark.parametrize(('kind', 'pack'), [
    ('zstd', zstandard.compress), ('lz4', lz4.frame.compress), ('bz2', bz2.compress)])
def test_what_is_packed_is_unpacked_within_the_limit(kind, pack):
    for content in (b'', b'content', os.urandom(3 * 2**20 + 1)):
        assert unpack(kind, pack(content)) == content
    bomb = pack(bytes(2**24))
    assert len(bomb) < 2**18
    assert len(unpack(kind, bomb, 2**24)) == 2**24
    with refused(InputError, 'E-BAG-TOO-LARGE', '8 MB'):
        unpack(kind, bomb, 2**23)
    with pytest.raises(EOFError):
        unpack(kind, bomb[:len(bomb) // 2])


NO_INDEX = {'index_types': IndexType.NONE, 'repeat_channels': False, 'repeat_schemas': False,
            'use_statistics': False, 'use_summary_offsets': False}


@pytest.fixture
def small_chunks(monkeypatch):
    """Let a chunk have 3000 bytes, unpacked."""
    monkeypatch.setattr(bag_read, 'CHUNK_BYTES', 3000)


@pytest.mark.parametrize('compression', [CompressionType.ZSTD, CompressionType.LZ4])
@pytest.mark.parametrize('options', [{}, NO_INDEX])
def test_a_chunk_that_is_a_bomb_is_left_out(tmp_path, compression, options, small_chunks):
    frames = drive(5)
    file = write_mcap(tmp_path / 'drive.mcap', frames, compression=compression, chunk_size=4000,
                      **options)
    fails('E-BAG-NOT-A-RECORDING' if 'use_statistics' in options else 'E-INPUT-NO-IMAGES', file,
          'damaged chunk', 'more than 0 MB')


@pytest.mark.parametrize('compression', Writer1.CompressionFormat)
def test_a_chunk_of_a_ros1_bag_that_is_a_bomb_is_left_out(tmp_path, compression, small_chunks):
    file = write_ros1(tmp_path / 'drive.bag', drive(5), compression)
    fails('E-INPUT-NO-IMAGES', file, 'more than 0 MB')


@pytest.mark.parametrize('options', [{}, NO_INDEX, {'index_types': IndexType.NONE}])
def test_chunks_are_unpacked_while_all_of_them_are_a_recording(tmp_path, options, monkeypatch):
    frames = drive(10)
    file = write_mcap(tmp_path / 'drive.mcap', frames, compression=CompressionType.ZSTD,
                      chunk_size=4000, **options)
    same(list(open_frames(file)), frames)
    monkeypatch.setattr(bag_read, 'UNPACKED_RATIO', 0)
    monkeypatch.setattr(bag_read, 'UNPACKED_LEAST', 15_000)
    source = open_frames(file)
    read = list(source)
    assert 0 < len(read) < 5
    same(read, frames[:len(read)])
    assert source.warnings[-1].code == 'E-BAG-IMAGES-LOST'
    assert 'more than 0 MB' in str(source.warnings[-1])


def test_a_ros1_bag_s_chunks_are_unpacked_while_all_of_them_are_a_recording(tmp_path, monkeypatch):
    monkeypatch.setattr(bag_read, 'UNPACKED_RATIO', 0)
    monkeypatch.setattr(bag_read, 'UNPACKED_LEAST', 15_000)
    file = write_ros1(tmp_path / 'drive.bag', drive(10), Writer1.CompressionFormat.BZ2)
    fails('E-INPUT-NO-IMAGES', file, 'more than 0 MB')


def test_only_so_many_overlapping_chunks_are_in_memory(tmp_path, monkeypatch):
    frames = drive(6)
    file = write_mcap(tmp_path / 'drive.mcap', [frames[n] for n in (0, 3, 1, 4, 2, 5)],
                      chunk_size=4000)
    monkeypatch.setattr(bag_read, 'OVERLAPPING_BYTES', 1)
    # in the order of the file, where what comes late is left out
    read = [frame.stamp_ns for frame in open_frames(file)]
    assert read == [frames[n].stamp_ns for n in (0, 3, 4, 5)]


TOPICS = """CREATE TABLE topics(id, name, type, serialization_format, offered_qos_profiles);
    INSERT INTO topics VALUES(1, '/camera', 'sensor_msgs/msg/Image', 'cdr', '');"""
COUNTED = 'WITH RECURSIVE c(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM c{})'
BLOB = "x'" + 10_000 * '00' + "'"


@pytest.mark.parametrize('made', [
    f'CREATE VIEW messages AS {COUNTED.format("")} SELECT n id, 1 topic_id, n timestamp, x data '
    f'FROM c, (SELECT zeroblob(1000) x)',
    'CREATE VIEW messages AS SELECT 1 id, 1 topic_id, 1 timestamp, randomblob(900000000) data',
    'CREATE TABLE messages(id, topic_id, timestamp, data AS (zeroblob(900000000))); '
    'INSERT INTO messages VALUES(1, 1, 1)',
    f'CREATE TABLE messages(id, topic_id, timestamp, data DEFAULT {BLOB}); '
    f'INSERT INTO messages(id, topic_id, timestamp) VALUES(1, 1, 1)'])
def test_only_what_is_stored_in_tables_is_read(tmp_path, made):
    with sqlite3.connect(tmp_path / 'odd.db3') as database:
        database.executescript(f'{TOPICS} {made};')
    fails('E-BAG-NOT-A-RECORDING', tmp_path / 'odd.db3', 'tables')


def test_a_query_of_a_database_ends(tmp_path, monkeypatch):
    monkeypatch.setattr(bag_read, 'PIECE', 1000)
    with sqlite3.connect(tmp_path / 'odd.db3') as database:
        database.executescript(
            f'{TOPICS} INSERT INTO topics {COUNTED.format(" LIMIT 500")} SELECT 1, n, "", "", "" '
            f'FROM c; CREATE TABLE messages(id, topic_id, timestamp, data); INSERT INTO messages '
            f'{COUNTED.format(" LIMIT 5000")} SELECT n, 1, n, x\'00\' FROM c;')
    with bag_read.within_limit(), pytest.raises(Exception, match='interrupted'):
        bag_read._reader(tmp_path / 'odd.db3').open()
    fails('E-BAG-TYPE-MISSING', tmp_path / 'odd.db3')


def test_a_ros1_bag_s_index_names_each_chunk_once(tmp_path):
    file = write_ros1(tmp_path / 'drive.bag', drive(400), Writer1.CompressionFormat.BZ2)
    data = file.read_bytes()
    # the last record tells of the last chunk: all of it again, as often as one likes
    record = next(data[at:] for at in range(len(data), 0, -1) if is_chunk_info(data[at:]))
    place = data.index(b'chunk_count=') + 12
    count = int.from_bytes(data[place:place + 4], 'little') + 50
    file.write_bytes(data[:place] + count.to_bytes(4, 'little') + data[place + 4:] + 50 * record)
    with bag_read.within_limit(), refused(InputError, 'E-BAG-INDEX', 'chunks overlap'):
        bag_read._reader(file).open()
    same(list(open_frames(file)), drive(400))


def is_chunk_info(data):
    """Return whether this is one whole record of a chunk's place."""
    stream = io.BytesIO(data)
    try:
        kind = Header.read(stream).get_uint8('op')
        return kind == 6 and len(stream.read(4)) == 4 and len(stream.read()) % 8 == 0
    except Exception:
        return False


@pytest.mark.parametrize('field', [b'conn_count=', b'chunk_count=', b'index_pos='])
@pytest.mark.parametrize('count', [0, 1, 2**31, 2**32 - 1])
def test_counts_of_a_ros1_bag_are_no_more_than_a_hint(tmp_path, field, count):
    file = write_ros1(tmp_path / 'drive.bag', drive(400), Writer1.CompressionFormat.BZ2)
    data = bytearray(file.read_bytes())
    place = data.index(field) + len(field)
    data[place:place + 4] = count.to_bytes(4, 'little')
    assert data.count(b'op=\x05') > 1
    file.write_bytes(data)
    same(list(open_frames(file)), drive(400))


def test_messages_of_overlapping_chunks_come_by_time(tmp_path):
    frames = drive(6)
    file = write_mcap(tmp_path / 'drive.mcap', [frames[n] for n in (0, 3, 1, 4, 2, 5)],
                      chunk_size=4000)
    assert [frame.stamp_ns for frame in open_frames(file)] == [each.stamp_ns for each in frames]


def test_a_message_that_is_a_bomb_is_an_undecodable_one(tmp_path, monkeypatch):
    bag = write_bag(tmp_path / 'bag', images(drive(3)), mode=CompressionMode.MESSAGE)
    same(list(open_frames(bag)), drive(3))
    monkeypatch.setattr(bag_read, 'MESSAGE_BYTES', 1000)
    fails('E-BAG-TOO-LARGE', bag, 'a message on /camera')


@pytest.mark.parametrize('plugin', StoragePlugin)
def test_a_file_that_is_a_bomb_ends_in_time(tmp_path, plugin, monkeypatch):
    bag = write_bag(tmp_path / 'bag', images(drive(3)), plugin)
    plain = storage(bag)
    packed = plain.with_name(f'{plain.name}.zstd')
    packed.write_bytes(zstandard.compress(plain.read_bytes() + bytes(2**24)))
    plain.unlink()
    (bag / 'metadata.yaml').unlink()
    monkeypatch.setattr(bag_read, 'UNPACKED_LEAST', 2**20)
    monkeypatch.setattr(bag_read, 'UNPACKED_RATIO', 2)
    for path in (bag, packed):
        fails('E-BAG-TOO-LARGE', path, '1 MB', 'zstd -d')
    with refused(InputError, 'E-BAG-DAMAGED', packed, '1 MB'):
        check_bag(packed, '/camera', tmp_path / 'out')


def test_unpacking_leaves_the_disk_room(tmp_path, monkeypatch):
    packed = tmp_path / 'drive.mcap.zstd'
    packed.write_bytes(zstandard.compress(write_mcap(tmp_path / 'drive.mcap', drive(3)
                                                     ).read_bytes()))
    monkeypatch.setattr(bag_read, 'FREE_BYTES', 2**60)
    fails('E-DISK-FULL', packed, packed, 'TMPDIR', 'zstd -d')
    monkeypatch.undo()
    same(list(open_frames(packed)), drive(3))


@pytest.mark.parametrize('metadata', [
    LAUGHS, '[' * 5000, 'rosbag2_bagfile_information: *x', '- ' * 3000])
def test_a_hostile_metadata_file_is_no_obstacle(tmp_path, metadata):
    bag = write_bag(tmp_path / 'bag', images(drive(3)))
    (bag / 'metadata.yaml').write_text(metadata)
    source = open_frames(bag)
    same(list(source), drive(3))
    assert source.warnings[0].code == 'E-BAG-NO-METADATA'
    with refused(InputError, 'E-BAG-DAMAGED', bag):
        check_bag(bag, '/camera', tmp_path / 'out')


@pytest.mark.parametrize('count', ['.inf', '-.inf', '.nan', '9' * 400, 'many', '[]'])
def test_a_count_that_is_none_is_no_obstacle(tmp_path, count):
    bag = write_bag(tmp_path / 'bag', images(drive(3)))
    path = bag / 'metadata.yaml'
    path.write_text(path.read_text().replace('message_count: 3', f'message_count: {count}'))
    assert count in path.read_text()
    source = open_frames(bag)
    same(list(source), drive(3))
    assert source.warnings[0].code == 'E-BAG-NO-METADATA'


@pytest.mark.parametrize('names', [
    ['../../etc/passwd'], ['/etc/passwd', '/dev/zero'], ['..', '.', ''],
    [f'f{n}.mcap' for n in range(1000)]])
def test_a_metadata_file_that_names_other_files_is_not_used(tmp_path, names):
    bag = write_bag(tmp_path / 'bag', images(drive(3)))
    source = open_frames(listing(bag, names))
    same(list(source), drive(3))
    assert source.warnings[0].code == 'E-BAG-NO-METADATA'


def test_a_file_that_is_listed_a_thousand_times_is_read_once(tmp_path):
    bag = write_bag(tmp_path / 'bag', images(drive(3)))
    source = open_frames(listing(bag, 1000 * [storage(bag).name]))
    same(list(source), drive(3))
    assert source.warnings == ()


def listing(bag, names):
    """Let a bag's metadata.yaml list these files."""
    path = bag / 'metadata.yaml'
    content = yaml.safe_load(path.read_text())
    content['rosbag2_bagfile_information']['relative_file_paths'] = names
    path.write_text(yaml.safe_dump(content))
    return bag


def test_a_metadata_file_that_is_a_pipe_is_no_obstacle(tmp_path):
    bag = write_bag(tmp_path / 'bag', images(drive(3)))
    (bag / 'metadata.yaml').unlink()
    os.mkfifo(bag / 'metadata.yaml')
    same(list(open_frames(bag)), drive(3))


def test_odd_entries_of_a_bag_are_skipped_and_named(tmp_path):
    bag = write_bag(tmp_path / 'bag', images(drive(3)))
    os.mkfifo(bag / 'a.mcap')
    (bag / 'b.db3').mkdir()
    (bag / 'c.bag').symlink_to('nowhere')
    source = open_frames(bag)
    same(list(source), drive(3))
    [warning] = source.warnings
    assert warning.code == 'E-BAG-FILES-SKIPPED'
    assert f'3 files in {bag}' in str(warning) and 'a.mcap, b.db3, c.bag' in str(warning)
    (bag / 'metadata.yaml').unlink()
    same(list(open_frames(bag)), drive(3))


def test_a_bag_of_odd_entries_alone_says_so(tmp_path):
    bag = write_bag(tmp_path / 'bag', images(drive(3)))
    storage(bag).unlink()
    os.mkfifo(bag / 'a.mcap')
    fails('E-BAG-NO-FILES', bag, '1 file in', 'a.mcap')


def test_a_raw_message_of_an_absurd_size_is_an_undecodable_one(tmp_path):
    message = ROS2.types['sensor_msgs/msg/Image'](
        header=head(1), height=2**31, width=2**31, encoding='mono8', is_bigendian=0, step=0,
        data=drive(1)[0].image.reshape(-1)[:0])
    fails('E-IMAGE-TOO-LARGE', write_bag(tmp_path / 'bag', [('/camera', 1, message)]),
          '2147483648x2147483648')


@pytest.mark.parametrize(('content', 'code'), [
    (b'no bag at all', 'E-BAG-NOT-A-RECORDING'),
    (b'\x89MCAP0\r\n' + b'\xff' * 40, 'E-BAG-DAMAGED')])
def test_a_repair_is_advised_where_it_may_help_only(tmp_path, content, code):
    path = tmp_path / 'drive.mcap'
    path.write_bytes(content)
    with refused(InputError, code, path) as caught:
        open_frames(path)
    assert ('mcap recover' in str(caught.value)) == (code == 'E-BAG-DAMAGED')


def test_pictures_of_another_kind_are_not_to_be_repaired(tmp_path):
    frames = drive(3)
    bag = write_bag(tmp_path / 'bag', [
        ('/camera', frame.stamp_ns, made_drives.image(frame, encoding='32FC1'))
        for frame in frames])
    with refused(InputError, 'E-IMAGE-ENCODING', '32FC1') as caught:
        list(open_frames(bag))
    assert 'recover' not in str(caught.value)
