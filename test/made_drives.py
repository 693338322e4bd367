# SPDX-License-Identifier: Apache-2.0
"""Drives of every kind, written for the tests of what reads them."""
from __future__ import annotations

from fractions import Fraction

import av
import cv2
import numpy as np
import yaml
from mcap.writer import Writer as McapWriter
from refused import refused
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from dashcalib_ros.camera import ros_camera
from dashcalib_ros.errors import InputError
from dashcalib_ros.input import Frame
from dashcalib_ros.input.inputs import open_frames

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


def info_of(camera, store=ROS2, **changes):
    """Make a CameraInfo as a driver does, for ROS 2 or 1."""
    kind = store.types['sensor_msgs/msg/CameraInfo']
    values = {'k': camera.matrix.ravel(), 'd': np.array(camera.ros_distortion()),
              'r': np.eye(3).ravel(), 'p': np.array(ros_camera(camera).p)}
    roi = store.types['sensor_msgs/msg/RegionOfInterest'](0, 0, 0, 0, False)
    return kind(**{
        'header': head(START, store), 'width': camera.image_size[0],
        'height': camera.image_size[1], 'distortion_model': camera.ros_model,
        **(values if store is ROS2 else {key.upper(): value for key, value in values.items()}),
        'binning_x': 0, 'binning_y': 0, 'roi': roi, **changes})


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


# s; no rate: 20, 33 and 66 ms apart, and a stretch at 8 Hz
STEPS = np.tile([0.033, 0.066, 0.020], 30)
STEPS[40:50] = 0.120
TIMES = np.concatenate([[0.0], np.cumsum(STEPS)[:-1]])


def numbered(index):
    """Make a picture that tells its index."""
    image = np.full((64, 160), 60, np.uint8)
    for bit in range(8):
        image[8:56, 8 + 18 * bit:22 + 18 * bit] = 220 if index >> bit & 1 else 20
    return image


def number(image):
    return sum(1 << bit for bit in range(8)
               if image[20:44, 11 + 18 * bit:19 + 18 * bit].mean() > 120)


def write_timed(path, times=TIMES, start=0.0, between=3, turn=0, created=None, aspect=None,
                **options):
    """Write a video of numbered pictures at these times.

    between: B-frames; turn: degrees; aspect: of a pixel.
    """
    tick = Fraction(1, 90000)
    with av.open(str(path), 'w', options=options) as container:
        if created:
            container.metadata['creation_time'] = created
        stream = container.add_stream('libx264', rate=30)
        stream.width, stream.height, stream.pix_fmt = 160, 64, 'yuv420p'
        stream.time_base = stream.codec_context.time_base = tick
        stream.codec_context.gop_size, stream.codec_context.max_b_frames = 30, between
        if aspect:
            stream.codec_context.sample_aspect_ratio = Fraction(*aspect)
        if turn:
            stream.set_display_rotation(turn)
        for index, time in enumerate(times):
            frame = av.VideoFrame.from_ndarray(numbered(index), format='gray8')
            frame = frame.reformat(format='yuv420p')
            frame.pts, frame.time_base = round((time + start) / tick), tick
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
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


def fails(code, path, *values, **options):
    """Check that opening or reading ends in an InputError of one line; return the line."""
    with refused(InputError, code, *values) as caught:
        list(open_frames(path, **options))
    return str(caught.value)


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


def suffix(plugin):
    return {StoragePlugin.MCAP: 'mcap', StoragePlugin.SQLITE3: 'db3'}[plugin]
