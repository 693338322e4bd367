"""Drives of every kind come in as the same frames; broken ones say what is wrong, in one line."""
import os
import subprocess
import sys
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
import zstandard
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

import dashcalib_ros.frames.quiet  # noqa: F401 (before our VideoWriter wakes FFmpeg)
from dashcalib_ros.errors import InputError, OutputError
from dashcalib_ros.frames import Frame, open_frames
from dashcalib_ros.frames.clock import Clock
from dashcalib_ros.frames.write import BagWriter

KITTI = Path(__file__).parents[2] / 'shared' / 'data' / 'kitti03' / 'bag'
START = 1_700_000_000_000_000_000
STEP = 100_000_000
IMAGE = 'sensor_msgs/msg/Image'
COMPRESSED = 'sensor_msgs/msg/CompressedImage'
ROS2 = get_typestore(Stores.ROS2_JAZZY)
ROS1 = get_typestore(Stores.ROS1_NOETIC)


def drive(count=20, width=64, height=48):
    """Make frames of noise (nothing to compress, so files can be cut anywhere)."""
    random = np.random.default_rng(7)
    return [Frame(index, START + index * STEP,
                  random.integers(0, 256, (height, width), np.uint8)) for index in range(count)]


def image(frame, store=ROS2, stamp_ns=None, encoding='mono8'):
    """Make the Image message of a frame."""
    header = head(frame.stamp_ns if stamp_ns is None else stamp_ns, store)
    width, height = frame.size
    return store.types[IMAGE](header=header, height=height, width=width, encoding=encoding,
                              is_bigendian=0, step=width, data=frame.image.reshape(-1))


def picture(frame, name='png', store=ROS2):
    """Make the CompressedImage message of a frame."""
    data = cv2.imencode('.png', frame.image)[1].reshape(-1)
    return store.types[COMPRESSED](header=head(frame.stamp_ns, store), format=name, data=data)


def head(stamp_ns, store=ROS2):
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    stamp = store.types['builtin_interfaces/msg/Time'](sec=seconds, nanosec=nanoseconds)
    more = {'seq': 0} if store is ROS1 else {}
    return store.types['std_msgs/msg/Header'](stamp=stamp, frame_id='camera', **more)


def text(content):
    return ROS2.types['std_msgs/msg/String'](data=content)


def write_bag(path, messages, plugin=StoragePlugin.MCAP, mode=CompressionMode.NONE, empty=()):
    """Write (topic, receive_ns, message) into a ROS 2 bag; `empty` topics have no messages."""
    writer = Writer(path, version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = {topic: writer.add_connection(topic, kind, typestore=ROS2)
                       for topic, kind in empty}
        for topic, receive_ns, message in messages:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ROS2)
            writer.write(connections[topic], receive_ns, ROS2.serialize_cdr(message, kind))
    return path


def images(frames, topic='/camera'):
    return [(topic, frame.stamp_ns, image(frame)) for frame in frames]


def write_ros1(path, frames, compression=None, compressed=False):
    writer = Writer1(path)
    if compression:
        writer.set_compression(compression)
    with writer:
        kind = COMPRESSED if compressed else IMAGE
        connection = writer.add_connection('/camera', kind, typestore=ROS1)
        for frame in frames:
            message = picture(frame, store=ROS1) if compressed else image(frame, ROS1)
            writer.write(connection, frame.stamp_ns, ROS1.serialize_ros1(message, kind))
    return path


def write_mcap(path, frames, profile='ros2', **options):
    """Write a single MCAP file as recorders do that make no index, or another profile."""
    definition, _ = ROS2.generate_msgdef(IMAGE, ros_version=2)
    with path.open('wb') as file:
        writer = McapWriter(file, **options)
        writer.start(profile, 'test')
        schema = writer.register_schema(IMAGE, 'ros2msg', definition.encode())
        channel = writer.register_channel('/camera', 'cdr', schema)
        for frame in frames:
            writer.add_message(channel, frame.stamp_ns,
                               bytes(ROS2.serialize_cdr(image(frame), IMAGE)), frame.stamp_ns)
        writer.finish()
    return path


def write_folder(path, frames, names='{:04d}.png'):
    path.mkdir()
    for frame in frames:
        assert cv2.imwrite(str(path / names.format(frame.index)), frame.image)
    return path


def smooth(count=12, width=64, height=48):
    """Make frames that survive a lossy codec: plain, each of another brightness."""
    return [Frame(index, 0, np.full((height, width), 20 + 15 * index, np.uint8))
            for index in range(count)]


def write_video(path, frames, codec='MJPG', fps=25.0):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), fps, frames[0].size)
    assert writer.isOpened()
    for frame in frames:
        writer.write(cv2.cvtColor(frame.image, cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


def cut(path, share, target=None):
    data = path.read_bytes()
    target = target or path
    target.write_bytes(data[:int(len(data) * share)])
    return target


def storage(folder):
    file, = (each for each in folder.iterdir() if each.name != 'metadata.yaml')
    return file


def same(found, expected, first_index=0):
    """Check that frames are the same in number, order, stamps and every pixel."""
    assert [frame.index for frame in found] == list(
        range(first_index, first_index + len(expected)))
    assert [frame.stamp_ns for frame in found] == [frame.stamp_ns for frame in expected]
    for one, other in zip(found, expected, strict=True):
        assert one.image.dtype == np.uint8
        np.testing.assert_array_equal(one.image, other.image)


def fails(match, path, **options):
    """Check that opening or reading ends in an InputError of one line; return the line."""
    with pytest.raises(InputError, match=match) as caught:
        list(open_frames(path, **options))
    assert len(str(caught.value).splitlines()) == 1
    return str(caught.value)


# --- what can be read ---------------------------------------------------------------------------


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
    assert 'no usable metadata.yaml' in source.warnings[0]


def split_bag(tmp_path, frames):
    """Write a bag of three files: 1.mcap, 2.mcap, 10.mcap."""
    bag = tmp_path / 'split'
    bag.mkdir()
    for part, name in enumerate(('1', '2', '10')):
        folder = write_bag(tmp_path / name, images(frames[part * 10:part * 10 + 10]))
        storage(folder).rename(bag / f'{name}.mcap')
    metadata = yaml.safe_load((folder / 'metadata.yaml').read_text())
    content = metadata['rosbag2_bagfile_information']
    content['relative_file_paths'] = ['old_name/1.mcap', '2.mcap', '10.mcap']
    content['message_count'] = len(frames)
    content['topics_with_message_count'][0]['message_count'] = len(frames)
    (bag / 'metadata.yaml').write_text(yaml.safe_dump(metadata))
    return bag


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
    assert source.warnings == (
        f'{bag} has no usable metadata.yaml: reading bag.{suffix(plugin)} in this order',)


def suffix(plugin):
    return {StoragePlugin.MCAP: 'mcap', StoragePlugin.SQLITE3: 'db3'}[plugin]


@pytest.mark.parametrize('plugin', StoragePlugin)
def test_a_path_with_odd_characters(tmp_path, plugin):
    frames = drive(5)
    bag = write_bag(tmp_path / 'bag', images(frames), plugin)
    same(list(open_frames(bag.rename(tmp_path / 'a b?#%20ü'))), frames)


@pytest.mark.parametrize('suffix, codec', [('.avi', 'MJPG'), ('.mp4', 'mp4v'), ('.mkv', 'MJPG')])
def test_videos(tmp_path, suffix, codec):
    frames = smooth()
    source = open_frames(write_video(tmp_path / f'drive{suffix}', frames, codec))
    assert source.count == 12
    assert source.topic is None
    for _ in range(2):
        found = list(source)
        assert [frame.stamp_ns for frame in found] == [index * 40_000_000 for index in range(12)]
        assert [frame.index for frame in found] == list(range(12))
        for one, other in zip(found, frames, strict=True):
            assert one.size == (64, 48)
            assert np.abs(one.image.astype(int) - other.image).max() <= 4
    assert source.warnings == ()
    assert [frame.stamp_ns for frame in open_frames(source.name, fps=10)][:2] == [0, STEP]


@pytest.mark.parametrize('names', ['{:04d}.png', '{}.png', 'left_{}.TIFF', 'x{}.bmp', '{}.pgm'])
def test_folders(tmp_path, names):
    frames = drive(12)
    folder = write_folder(tmp_path / 'images', frames, names)
    (folder / 'times.txt').write_text('0\n')
    (folder / '._0001.png').write_bytes(b'a file that macOS leaves about')
    source = open_frames(folder, fps=20)
    assert source.count == 12
    expected = [Frame(frame.index, frame.index * 50_000_000, frame.image) for frame in frames]
    same(list(source), expected)
    same(list(source), expected)
    assert source.warnings == ()


def test_a_folder_runs_at_ten_hertz_unless_told(tmp_path):
    source = open_frames(write_folder(tmp_path / 'images', drive(3)))
    assert [frame.stamp_ns for frame in source] == [0, STEP, 2 * STEP]
    assert '--fps' in source.warnings[0]


def test_what_does_not_apply_is_said(tmp_path):
    folder = open_frames(write_folder(tmp_path / 'images', drive(3)), topic='/camera', fps=10)
    bag = open_frames(write_bag(tmp_path / 'bag', images(drive(3))), fps=5)
    video = open_frames(write_video(tmp_path / 'v.avi', smooth()), topic='/camera')
    assert 'topic /camera is ignored' in folder.warnings[0]
    assert 'fps is ignored' in bag.warnings[0]
    assert 'topic /camera is ignored' in video.warnings[0]
    assert [frame.stamp_ns for frame in bag] == [frame.stamp_ns for frame in drive(3)]


def test_frames_are_read_one_by_one(tmp_path):
    bag = write_bag(tmp_path / 'bag', images(drive(60, 320, 240)))
    source = open_frames(bag)
    opened = iter(source)
    assert next(opened).index == 0
    os.truncate(storage(bag), storage(bag).stat().st_size // 2)
    assert 10 < sum(1 for _ in opened) < 35  # the second half is read only now
    assert 'are lost' in source.warnings[0]
    folder = open_frames(write_folder(tmp_path / 'images', drive(6)))
    opened = iter(folder)
    next(opened)
    (tmp_path / 'images' / '0004.png').write_bytes(b'junk')
    assert [frame.index for frame in opened] == [1, 2, 3, 5]


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


def test_importing_frames_is_light():
    code = ('import sys, dashcalib_ros.frames; '
            'print([name for name in ("cv2", "rosbags", "mcap") if name in sys.modules])')
    found = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                           check=True, cwd=Path(__file__).parents[1])
    assert found.stdout == '[]\n'


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


# --- topics -------------------------------------------------------------------------------------


def two_cameras(tmp_path):
    frames = drive(4)
    other = drive(3, 32, 24)
    return write_bag(tmp_path / 'bag', [
        *images(frames, '/left'),
        *[('/right/compressed', frame.stamp_ns, picture(frame)) for frame in other],
        ('/words', START, text('hello'))])


def test_several_image_topics_are_listed(tmp_path):
    line = fails('2 image topics: choose one with --topic', two_cameras(tmp_path))
    assert '/left (Image, 4 images, 64x48)' in line
    assert '/right/compressed (CompressedImage, 3 images, 32x24)' in line
    assert '/words' not in line


@pytest.mark.parametrize('topic', ['/left', 'left'])
def test_a_chosen_topic_is_read_alone(tmp_path, topic):
    source = open_frames(two_cameras(tmp_path), topic=topic)
    assert (source.topic, source.count) == ('/left', 4)
    same(list(source), drive(4))


@pytest.mark.parametrize('topic', ['/middle', '/words'])
def test_a_wrong_topic_lists_what_there_is(tmp_path, topic):
    line = fails(f"no image topic '{topic}'", two_cameras(tmp_path), topic=topic)
    assert '/left (Image' in line and '/right/compressed (' in line


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
    fails(r'no image topic: it has /words \(std_msgs/msg/String\); record the camera', words)
    nothing = write_bag(tmp_path / 'nothing', [])
    fails('no messages at all', nothing)
    unused = write_bag(tmp_path / 'unused', [('/words', START, text('hello'))],
                       empty=[('/camera', IMAGE)])
    fails('no images on /camera', unused)


# --- stamps -------------------------------------------------------------------------------------


def test_without_header_stamps_the_times_of_reception_count(tmp_path):
    frames = drive(5)
    source = open_frames(write_bag(tmp_path / 'bag', [
        ('/camera', frame.stamp_ns, image(frame, stamp_ns=0)) for frame in frames]))
    same(list(source), frames)
    assert source.warnings == (
        'the image headers have no stamps: the times of reception were taken',)


def test_images_that_come_twice_or_late_are_skipped(tmp_path):
    frames = drive(6)
    stamps = [0, 1, 1, 3, 2, 5]
    source = open_frames(write_bag(tmp_path / 'bag', [
        ('/camera', frame.stamp_ns, image(frame, stamp_ns=START + stamp * STEP))
        for frame, stamp in zip(frames, stamps, strict=True)]))
    found = list(source)
    assert [frame.index for frame in found] == [0, 1, 3, 5]
    assert [(frame.stamp_ns - START) // STEP for frame in found] == [0, 1, 3, 5]
    assert '2 images were skipped' in source.warnings[0]


def test_a_clock_that_is_set_back_loses_no_image():
    clock = Clock()
    stamps = [clock.stamp(hour * 3600 * 10**9 + tenth * STEP, 0)
              for hour, tenth in ((5, 0), (5, 1), (4, 0), (4, 1), (4, 3))]
    steps = np.diff(np.array(stamps, np.int64)) // STEP
    assert steps.tolist() == [1, 1, 1, 2]
    assert clock.warnings() == ['the clock was set back 1 times, by up to 3600.1 s: '
                                'time was taken to go on']


# --- damage -------------------------------------------------------------------------------------


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
    assert f'read {len(found)} of 60 images; ' in warning
    assert ('none is lost' if len(found) == 60 else f'{60 - len(found)} are lost') in warning

    alone = open_frames(file)
    same(list(alone), found)
    assert f'read {len(found)} images; how many are lost is not known' in alone.warnings[0]


@pytest.mark.parametrize('compression', [None, *Writer1.CompressionFormat])
@pytest.mark.parametrize('share', [0.4, 0.8, 0.9995])
def test_a_cut_ros1_bag_gives_what_precedes_the_cut(tmp_path, compression, share):
    frames = drive(60, 320, 240)
    source = open_frames(
        cut(write_ros1(tmp_path / 'drive.bag', frames, compression), share))
    found = list(source)
    assert 60 * share - 18 <= len(found) <= 60
    same(found, frames[:len(found)])
    assert f'read {len(found)} images; how many are lost is not known' in source.warnings[0]


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
    assert f'read {len(found)} ' in source.warnings[0]


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
    assert f'read {len(found)} of 60 images; {60 - len(found)} are lost' in source.warnings[0]
    assert 'broken chunk' in source.warnings[0]


def test_a_split_bag_with_a_missing_and_a_broken_file(tmp_path):
    frames = drive(30)
    bag = split_bag(tmp_path, frames)
    (bag / '2.mcap').write_bytes(os.urandom(1000))
    source = open_frames(bag)
    assert len(list(source)) == 20
    assert 'read 20 of 30 images; 10 are lost' in source.warnings[0]
    (bag / '2.mcap').unlink()
    source = open_frames(bag)
    assert [frame.stamp_ns for frame in source] == [
        frame.stamp_ns for frame in frames[:10] + frames[20:]]
    assert '2.mcap is listed in metadata.yaml but missing' in source.warnings[0]
    assert 'read 20 of 30 images; 10 are lost' in source.warnings[1]


def test_undecodable_images_are_skipped_and_counted(tmp_path):
    frames = drive(6)
    messages = [('/camera', frame.stamp_ns, picture(frame)) for frame in frames]
    messages[2][2].data = messages[2][2].data[:100]
    messages[4][2].data = np.zeros(0, np.uint8)
    source = open_frames(write_bag(tmp_path / 'bag', messages))
    assert [frame.index for frame in source] == [0, 1, 3, 5]
    assert '2 undecodable images were skipped (image 2: png image' in source.warnings[0]
    folder = write_folder(tmp_path / 'images', frames)
    cut(folder / '0003.png', 0.5)
    source = open_frames(folder, fps=10)
    assert [frame.index for frame in source] == [0, 1, 2, 4, 5]
    assert '1 undecodable images were skipped (image 3: 0003.png' in source.warnings[0]


def test_nothing_decodable_is_an_error_that_says_why(tmp_path):
    bag = write_bag(tmp_path / 'bag', [
        ('/camera', frame.stamp_ns, image(frame, encoding='rgb565')) for frame in drive(3)])
    fails("gave no image .image 0: encoding 'rgb565' is not supported: publish mono8", bag)
    folder = tmp_path / 'images'
    folder.mkdir()
    (folder / '1.png').write_bytes(b'junk')
    fails('gave no image .image 0: 1.png is damaged', folder)


def test_a_change_of_size_is_an_error(tmp_path):
    frames = [*drive(3), Frame(3, START + 3 * STEP, np.zeros((24, 32), np.uint8))]
    for path in (write_bag(tmp_path / 'bag', images(frames)),
                 write_folder(tmp_path / 'images', frames)):
        fails('image 3 is 32x24, those before are 64x48: .*split the drive', path)


@pytest.mark.parametrize('codec, suffix', [('mp4v', '.mp4'), ('MJPG', '.avi')])
def test_a_cut_video(tmp_path, codec, suffix):
    path = cut(write_video(tmp_path / f'drive{suffix}', drive(50), codec), 0.5)
    if suffix == '.mp4':  # its index is at the end
        fails('no video that can be played, or it is cut off', path)
    else:
        source = open_frames(path)
        found = len(list(source))
        assert 20 <= found <= 26
        if source.count != found:
            assert 'are lost' in source.warnings[0]


# --- what is no drive at all --------------------------------------------------------------------


def test_paths_that_are_no_drive(tmp_path):
    fails('does not exist: check the path', tmp_path / 'missing.mcap')
    fails('does not exist', tmp_path / 'missing' / 'deeper')
    (tmp_path / 'empty').mkdir()
    fails('is empty: give a folder', tmp_path / 'empty')
    (tmp_path / 'texts').mkdir()
    (tmp_path / 'texts' / 'a.txt').write_text('hello')
    fails('has no images .* it has a.txt; give', tmp_path / 'texts')
    (tmp_path / 'bag').mkdir()
    (tmp_path / 'bag' / 'metadata.yaml').write_text('a: 1')
    fails('no .mcap, .db3 or .bag file: copy the whole folder', tmp_path / 'bag')
    fails('no kind of drive known here', tmp_path / 'texts' / 'a.txt')
    cv2.imwrite(str(tmp_path / 'one.png'), np.zeros((4, 4), np.uint8))
    fails('single image: give the folder', tmp_path / 'one.png')


SUFFIXES = ['.mcap', '.db3', '.bag', '.mp4', '.avi', '.mcap.zstd', '.db3.zstd']


@pytest.mark.parametrize('suffix', SUFFIXES)
def test_empty_files(tmp_path, suffix):
    path = tmp_path / f'drive{suffix}'
    path.touch()
    fails('is empty: the recording or the copy failed', path)


@pytest.mark.parametrize('suffix', SUFFIXES)
@pytest.mark.parametrize('start', [b'', b'\x89MCAP0\r\n', b'SQLite format 3\0', b'#ROSBAG V2.0\n',
                                   b'\x28\xb5\x2f\xfd'])
def test_junk(tmp_path, suffix, start, capfd):
    junk = np.random.default_rng(3).integers(0, 256, 5000, np.uint8).tobytes()
    path = tmp_path / f'drive{suffix}'
    path.write_bytes(start + junk)
    cure = 'copy it again'
    fails(cure, path)
    assert capfd.readouterr() == ('', '')


@pytest.mark.parametrize('plugin', StoragePlugin)
def test_a_bag_folder_of_junk(tmp_path, plugin):
    bag = write_bag(tmp_path / 'bag', images(drive(5)), plugin)
    storage(bag).write_bytes(b'junk' * 100)
    line = fails('gave no image .*read 0 of 5 images; 5 are lost', bag)
    assert 'ros2 bag reindex' in line


def test_flipped_bytes_never_end_in_another_error(tmp_path):
    random = np.random.default_rng(5)
    whole = [storage(write_bag(tmp_path / 'mcap', images(drive(5)))),
             storage(write_bag(tmp_path / 'db3', images(drive(5)), StoragePlugin.SQLITE3)),
             write_ros1(tmp_path / 'drive.bag', drive(5)),
             write_mcap(tmp_path / 'drive.mcap', drive(5))]
    outcomes = set()
    for file in whole:
        data = np.frombuffer(file.read_bytes(), np.uint8)
        for _ in range(25):
            broken = data.copy()
            # at the start and at the end: there are the structures, between them is noise
            places = random.integers(0, 600, 3) * random.choice([-1, 1], 3)
            broken[places] = random.integers(0, 256, 3)
            copy = tmp_path / f'broken{file.suffix}'
            copy.write_bytes(broken.tobytes())
            try:
                outcomes.add(len(list(open_frames(copy))))
            except InputError as error:
                assert len(str(error).splitlines()) == 1
                outcomes.add('error')
    assert {5, 'error'} <= outcomes


@pytest.mark.parametrize('fps', [0, -1, float('nan'), float('inf'), 1001])
def test_nonsense_rates(tmp_path, fps):
    fails('fps must be above 0', write_folder(tmp_path / 'images', drive(2)), fps=fps)


@pytest.mark.parametrize('rate', [0.0, float('nan'), 90000.0])
def test_a_video_that_does_not_know_its_rate(tmp_path, rate, monkeypatch):
    path = write_video(tmp_path / 'drive.avi', smooth())
    capture = cv2.VideoCapture

    class Nonsense:
        def __init__(self, *arguments):
            self.real = capture(*arguments)

        def get(self, key):
            return rate if key == cv2.CAP_PROP_FPS else self.real.get(key)

        def __getattr__(self, name):
            return getattr(self.real, name)

    monkeypatch.setattr(cv2, 'VideoCapture', Nonsense)
    fails('give the rate with --fps', path)
    assert [frame.stamp_ns for frame in open_frames(path, fps=10)][1] == STEP


@pytest.fixture
def nobody(tmp_path):
    """Give up root's power to read everything, and a place where others may look."""
    opened = [folder for folder in tmp_path.parents if folder.stat().st_uid == os.getuid()
              and len(folder.parts) > 2]
    modes = [(folder, folder.stat().st_mode) for folder in opened]
    for folder, mode in modes:
        folder.chmod(mode | 0o055)
    user = os.geteuid()
    if user == 0:
        os.seteuid(65534)
    yield tmp_path
    os.seteuid(user)
    for folder, mode in modes:
        folder.chmod(mode)


@pytest.mark.skipif(not hasattr(os, 'geteuid'), reason='permissions are of POSIX')
@pytest.mark.parametrize('name', ['drive.mcap', 'drive.bag', 'drive.mp4', 'folder', 'bag/x.mcap'])
def test_what_may_not_be_read(tmp_path, name, request):
    tmp_path.chmod(0o755)
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    if name == 'folder':
        path.mkdir()
    else:
        path.write_bytes(b'x' * 100)
    path.chmod(0)
    request.getfixturevalue('nobody')
    fails('may not be read: change its permissions', path if '/' not in name else path.parent)


# --- writing ------------------------------------------------------------------------------------


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


def test_a_single_zstd_file_of_the_zstd_tool(tmp_path):
    frames = drive(5)
    plain = write_mcap(tmp_path / 'drive.mcap', frames)
    packed = tmp_path / 'drive.mcap.zstd'
    packed.write_bytes(zstandard.compress(plain.read_bytes()))
    plain.unlink()
    same(list(open_frames(packed)), frames)
