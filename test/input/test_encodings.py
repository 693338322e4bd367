# SPDX-License-Identifier: Apache-2.0
"""Videos in messages, Foxglove's messages in protobuf and JSON, and what is not read."""
from __future__ import annotations

import base64
import json

import cv2
import numpy as np
import pytest
from google.protobuf import descriptor_pb2, timestamp_pb2
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Field
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from made_drives import COMPRESSED, ROS1, ROS2, START, STEP, head, info_of
from made_packets import SIZE, encoded, levels
from mcap.reader import make_reader
from mcap.writer import Writer
from refused import refused
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores

from dashcalib_ros.camera import Fisheye, Radial
from dashcalib_ros.cli import main
from dashcalib_ros.errors import InputError
from dashcalib_ros.formats import export, load_camera
from dashcalib_ros.input.bag_write import check_bag, first_camera_info, write_bag
from dashcalib_ros.input.encodings import message_of, types
from dashcalib_ros.input.inputs import open_frames
from dashcalib_ros.input.packets import PacketDecoder

LENS = Radial(SIZE, 50.0, 51.0, 31.0, 23.0, -0.1, 0.01)
FURTHER = types(Stores.ROS2_JAZZY)


def video_message(kind, number, data, name):
    stamp_ns = START + number * STEP
    if kind == 'ffmpeg_image_transport_msgs/msg/FFMPEGPacket':
        return FURTHER.types[kind](header=head(stamp_ns), width=SIZE[0], height=SIZE[1],
                                   encoding=name, pts=number, flags=0, is_bigendian=False,
                                   data=np.frombuffer(data, np.uint8))
    if kind == COMPRESSED:
        return FURTHER.types[kind](header=head(stamp_ns), format=name,
                                   data=np.frombuffer(data, np.uint8))
    return FURTHER.types[kind](timestamp=head(stamp_ns).stamp, frame_id='camera', format=name,
                               data=np.frombuffer(data, np.uint8))


def write_packets(path, packets, kind, name, topic='/cam/video', plugin=StoragePlugin.MCAP):
    with Writer2(path, version=9, storage_plugin=plugin) as writer:
        connection = writer.add_connection(topic, kind, typestore=FURTHER)
        for n, (number, data) in enumerate(packets):
            message = video_message(kind, number, data, name)
            writer.write(connection, START + n * STEP, FURTHER.serialize_cdr(message, kind))
    return path


def brightness(frames):
    return [round((float(frame.image.mean()) - 40) / 8) for frame in frames]


PACKET = 'ffmpeg_image_transport_msgs/msg/FFMPEGPacket'


@pytest.mark.parametrize('plugin', [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
@pytest.mark.parametrize(('kind', 'codec', 'name'), [
    ('foxglove_msgs/msg/CompressedVideo', 'libx264', 'h264'),
    ('foxglove_msgs/msg/CompressedVideo', 'libx265', 'h265'),
    (PACKET, 'libx264', 'libx264'), (PACKET, 'libx265', 'hevc_nvenc'),
    (PACKET, 'libx264', 'h264;yuv420p;bgr8;bgr8'), (COMPRESSED, 'libx264', 'h264')])
def test_a_video_in_messages_is_decoded(tmp_path, kind, codec, name, plugin):
    bag = write_packets(tmp_path / 'bag', encoded(levels(), codec), kind, name, plugin=plugin)
    source = open_frames(bag)
    frames = list(source)
    assert brightness(frames) == list(range(20)) and not source.warnings
    assert [frame.stamp_ns for frame in frames] == [START + n * STEP for n in range(20)]
    assert {(frame.size, frame.frame_id) for frame in frames} == {(SIZE, 'camera')}
    colours = source.in_colour({3: START + 3 * STEP})
    assert colours[3].shape == (*SIZE[::-1], 3)


@pytest.mark.parametrize('kind', [PACKET, 'foxglove_msgs/msg/CompressedVideo'])
@pytest.mark.parametrize(('codec', 'name', 'options'), [
    ('libsvtav1', 'librav1e', {'preset': '12', 'svtav1-params': 'lookahead=0:pred-struct=1'}),
    ('libvpx-vp9', 'vp9', {'deadline': 'realtime', 'lag-in-frames': '0'}),
    ('libvpx', 'vp8', {'deadline': 'realtime', 'lag-in-frames': '0'})])
def test_a_video_of_other_codecs_is_decoded_without_hardware(tmp_path, kind, codec, name, options):
    packets = encoded(levels(), codec, 8, **options)
    bag = write_packets(tmp_path / 'bag', packets, kind, name)
    source = open_frames(bag)
    assert np.allclose(brightness(source), range(20), atol=1) and not source.warnings
    late = open_frames(write_packets(tmp_path / 'late', packets[3:], kind, name))
    assert np.allclose(brightness(late), range(8, 20), atol=1)
    assert [each.code for each in late.warnings] == ['E-VIDEO-BEGINS-LATE']
    assert 'the first 5 images' in str(late.warnings[0])


def test_a_decoder_that_fails_is_named(tmp_path, monkeypatch):
    packets = encoded(levels(), 'libsvtav1', 8, preset='12')
    bag = write_packets(tmp_path / 'bag', packets, PACKET, 'librav1e')
    monkeypatch.setattr('dashcalib_ros.input.packets.SOFTWARE', {})
    with refused(InputError, 'E-VIDEO-DECODER', bag, 'av1'):
        list(open_frames(bag))


@pytest.mark.parametrize('kind', [PACKET, 'foxglove_msgs/msg/CompressedVideo'])
def test_a_video_in_a_bag_of_ros_1(tmp_path, kind):
    store = types(Stores.ROS1_NOETIC)
    with Writer1(tmp_path / 'drive.bag') as writer:
        connection = writer.add_connection('/cam/video', kind, typestore=store)
        for number, data in encoded(levels()):
            stamp = head(START + number * STEP, ROS1)
            values = {'data': np.frombuffer(data, np.uint8)}
            if kind == PACKET:
                values |= {'header': stamp, 'width': 64, 'height': 48, 'encoding': 'h264',
                           'pts': number, 'flags': 0, 'is_bigendian': False}
            else:
                values |= {'timestamp': stamp.stamp, 'frame_id': 'camera', 'format': 'h264'}
            message = store.types[kind](**values)
            writer.write(connection, START + number * STEP, store.serialize_ros1(message, kind))
    frames = list(open_frames(tmp_path / 'drive.bag'))
    assert brightness(frames) == list(range(20)) and frames[3].stamp_ns == START + 3 * STEP


def test_pictures_between_others_get_their_own_stamps(tmp_path):
    packets = encoded(levels(), bf='2', preset='medium')
    assert [number for number, _ in packets] != sorted(number for number, _ in packets)
    frames = list(open_frames(write_packets(tmp_path / 'bag', packets, PACKET, 'libx264')))
    assert brightness(frames) == list(range(20))
    assert [frame.stamp_ns for frame in frames] == [START + n * STEP for n in range(20)]


@pytest.mark.parametrize('codec', ['libx264', 'libx265'])
def test_a_recording_that_begins_late_waits_for_a_key_picture(tmp_path, codec):
    packets = encoded(levels(), codec)[3:]
    bag = write_packets(tmp_path / 'bag', packets, PACKET, codec)
    source = open_frames(bag)
    frames = list(source)
    assert brightness(frames) == list(range(8, 20))
    assert [frame.index for frame in frames] == list(range(5, 17))
    assert [each.code for each in source.warnings] == ['E-VIDEO-BEGINS-LATE']
    assert 'the first 5 images' in str(source.warnings[0])


def test_damaged_packets_are_counted_and_the_rest_is_shown(tmp_path):
    packets = encoded(levels(), key_every=1)
    packets[4] = 4, b'\0\0\0\1\x65' + bytes(50)
    source = open_frames(write_packets(tmp_path / 'bag', packets, PACKET, 'libx264'))
    shown = brightness(source)
    assert set(range(20)) - set(shown) <= {4} and len(shown) >= 19
    decoder = PacketDecoder()
    assert len(decoder.take('h264', packets[0][1], 0)) == 1
    with refused(InputError, 'E-VIDEO-PACKET'):
        decoder.take('h264', packets[4][1], 4)
    junk = [(n, bytes([n]) * 40) for n in range(9)]
    with refused(InputError, 'E-INPUT-NO-IMAGES', tmp_path / 'junk'):
        list(open_frames(write_packets(tmp_path / 'junk', junk, PACKET, 'libx264')))
    with refused(InputError, 'E-VIDEO-CODEC', "'mpeg4'"):
        list(open_frames(write_packets(tmp_path / 'other', junk, PACKET, 'mpeg4')))


# Foxglove's own messages -----------------------------------------------------------------------

FIELDS = {
    'CompressedImage': {'timestamp': 1, 'data': 2, 'format': 3, 'frame_id': 4},
    'CompressedVideo': {'timestamp': 1, 'frame_id': 2, 'data': 3, 'format': 4},
    'RawImage': {'timestamp': 1, 'width': 2, 'height': 3, 'encoding': 4, 'step': 5, 'data': 6,
                 'frame_id': 7},
    'CameraCalibration': {'timestamp': 1, 'width': 2, 'height': 3, 'distortion_model': 4, 'D': 5,
                          'K': 6, 'R': 7, 'P': 8, 'frame_id': 9}}
KINDS = {'timestamp': Field.TYPE_MESSAGE, 'data': Field.TYPE_BYTES,
         **dict.fromkeys(('width', 'height', 'step'), Field.TYPE_FIXED32),
         **dict.fromkeys('DKRP', Field.TYPE_DOUBLE)}


def foxglove_schema(name, shift=0):
    """Return a FileDescriptorSet as writers put it into an MCAP file; shift: of its numbers."""
    file = descriptor_pb2.FileDescriptorProto(
        name=f'foxglove/{name}.proto', package='foxglove', syntax='proto3',
        dependency=['google/protobuf/timestamp.proto'])
    message = file.message_type.add(name=name)
    for field, number in FIELDS[name].items():
        kind = KINDS.get(field, Field.TYPE_STRING)
        message.field.add(
            name=field, number=number + shift, type=kind,
            label=Field.LABEL_REPEATED if field in 'DKRP' else Field.LABEL_OPTIONAL,
            type_name='.google.protobuf.Timestamp' if field == 'timestamp' else None)
    stamp = descriptor_pb2.FileDescriptorProto.FromString(timestamp_pb2.DESCRIPTOR.serialized_pb)
    # as some do, a file before the one that it imports
    return descriptor_pb2.FileDescriptorSet(file=[file, stamp])


def in_protobuf(name, values, shift=0):
    pool = DescriptorPool()
    for file in reversed(foxglove_schema(name, shift).file):
        pool.AddSerializedFile(file.SerializeToString())
    message = GetMessageClass(pool.FindMessageTypeByName(f'foxglove.{name}'))()
    for field, value in values.items():
        if field == 'timestamp':
            message.timestamp.FromNanoseconds(value)
        elif field in 'DKRP':
            getattr(message, field).extend(value)
        else:
            setattr(message, field, value)
    return message.SerializeToString()


def in_json(name, values):
    seconds, parts = divmod(values['timestamp'], 10**9)
    plain = {**values, 'timestamp': {'sec': seconds, 'nsec': parts}}
    if 'data' in values:
        plain['data'] = base64.b64encode(values['data']).decode()
    return json.dumps(plain).encode()


def picture_values(name, number, data):
    values = {'timestamp': START + number * STEP, 'frame_id': 'camera'}
    if name == 'CompressedImage':
        jpeg = cv2.imencode('.jpg', data)[1].tobytes()
        return {**values, 'data': jpeg, 'format': 'jpeg'}
    if name == 'RawImage':
        return {**values, 'width': SIZE[0], 'height': SIZE[1], 'encoding': 'mono8',
                'step': SIZE[0], 'data': data.tobytes()}
    return {**values, 'data': data, 'format': 'h264'}


def calibration_values(camera, model=None):
    d = [float(value) for value in camera.ros_distortion()]
    p = np.column_stack([camera.matrix, np.zeros(3)])
    return {'timestamp': START, 'frame_id': 'camera', 'width': SIZE[0], 'height': SIZE[1],
            'distortion_model': model or camera.ros_model, 'D': d,
            'K': camera.matrix.ravel().tolist(), 'R': np.eye(3).ravel().tolist(),
            'P': p.ravel().tolist()}


def write_foxglove(path, name, encoding, with_schema=True, shift=0, camera=LENS, model=None,
                   more=()):
    """Write pictures and a calibration as Foxglove's writers do, beside a topic of ROS."""
    pictures = encoded(levels()) if name == 'CompressedVideo' else list(enumerate(levels()))
    with path.open('wb') as file:
        writer = Writer(file)
        writer.start()

        def channel(topic, kind):
            if encoding == 'protobuf':
                schema = foxglove_schema(kind, shift).SerializeToString()
                about = 'protobuf', schema if with_schema else b''
            elif encoding == 'json':
                about = 'jsonschema', b'{"type": "object"}' if with_schema else b''
            else:
                about = 'flatbuffer', b''
            return writer.register_channel(topic, encoding, writer.register_schema(
                f'foxglove.{kind}', *about))

        def bytes_of(kind, values):
            if encoding == 'protobuf':
                return in_protobuf(kind, values, shift)
            return in_json(kind, values)

        camera_topic = channel('/cam/image', name)
        info_topic = channel('/cam/camera_info', 'CameraCalibration')
        text = writer.register_channel('/text', 'cdr', writer.register_schema(
            'std_msgs/msg/String', 'ros2msg', b'string data\n'))
        for n, (number, data) in enumerate(pictures):
            time = START + n * STEP
            writer.add_message(text, time, bytes(ROS2.serialize_cdr(
                ROS2.types['std_msgs/msg/String'](data=f'{n}'), 'std_msgs/msg/String')), time)
            writer.add_message(info_topic, time, bytes_of(
                'CameraCalibration', calibration_values(camera, model)), time)
            writer.add_message(camera_topic, time, bytes_of(
                name, picture_values(name, number, data)), time)
        writer.finish()
    return path


@pytest.mark.parametrize('encoding', ['protobuf', 'json'])
@pytest.mark.parametrize('with_schema', [True, False])
@pytest.mark.parametrize('name', ['CompressedImage', 'RawImage', 'CompressedVideo'])
def test_foxglove_s_pictures_are_read(tmp_path, name, encoding, with_schema):
    path = write_foxglove(tmp_path / 'drive.mcap', name, encoding, with_schema)
    source = open_frames(path)
    frames = list(source)
    assert brightness(frames) == list(range(20)) and not source.warnings
    assert [frame.stamp_ns for frame in frames] == [START + n * STEP for n in range(20)]
    assert {(frame.size, frame.frame_id) for frame in frames} == {(SIZE, 'camera')}


def test_a_bag_s_own_schema_is_used(tmp_path):
    path = write_foxglove(tmp_path / 'drive.mcap', 'RawImage', 'protobuf', shift=7)
    assert brightness(open_frames(path)) == list(range(20))


FISHEYE = Fisheye(SIZE, 30.0, 31.0, 32.0, 24.0, 0.1, 0.01, 0.001, 0.0001)


@pytest.mark.parametrize('encoding', ['protobuf', 'json'])
@pytest.mark.parametrize(('camera', 'model'), [
    (LENS, None), (FISHEYE, 'kannala_brandt'),
    (Radial(SIZE, 50.0, 51.0, 31.0, 23.0), ''), (LENS, 'rational_polynomial')])
def test_foxglove_s_calibrations_are_read(tmp_path, encoding, camera, model):
    path = write_foxglove(tmp_path / 'drive.mcap', 'RawImage', encoding, camera=camera,
                          model=model or None)
    assert load_camera(path).camera == camera


@pytest.mark.parametrize('camera', [LENS, FISHEYE])
def test_a_calibration_for_foxglove(tmp_path, camera):
    text = export(camera, 'foxglove')
    found = json.loads(text)
    assert found['distortion_model'] == (
        'kannala_brandt' if camera is FISHEYE else 'plumb_bob')
    assert (found['width'], found['height'], len(found['P'])) == (*SIZE, 12)
    (tmp_path / 'camera.json').write_text(text)
    assert load_camera(tmp_path / 'camera.json').camera == camera
    # Foxglove's own class takes it, but for the time's name
    values = {**found, 'timestamp': START}
    assert in_protobuf('CameraCalibration', values)


def test_what_is_not_read_is_named_by_its_encoding(tmp_path, capsys):
    path = write_foxglove(tmp_path / 'drive.mcap', 'RawImage', 'flatbuffer')
    with refused(InputError, 'E-BAG-NO-IMAGES', '/cam/image (foxglove.RawImage in flatbuffer)'):
        open_frames(path)
    assert main(['turns', str(path)]) == 2 and 'protobuf, json' in capsys.readouterr().err


@pytest.mark.parametrize('schema', [
    b'\xff' * 40, b'', foxglove_schema('RawImage').SerializeToString()])
@pytest.mark.parametrize('encoding', ['protobuf', 'json'])
def test_damaged_messages_and_schemas_are_one_line(tmp_path, encoding, schema):
    path = tmp_path / 'drive.mcap'
    with path.open('wb') as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel('/a', encoding, writer.register_schema(
            'foxglove.RawImage', encoding, schema))
        raw = in_json('RawImage', picture_values('RawImage', 0, levels(1)[0])).decode()
        for n, data in enumerate((
                b'\xff\xff\xff', b'{"data": "?"}', b'[]', b'{"timestamp": 3}', b'', b'null',
                raw.replace('64', '"x"').encode(), raw.replace('64', '1e999').encode(),
                raw.replace('64', '-64').encode(), raw.replace('"mono8"', '{}').encode(),
                raw.replace(f'{{"sec": {START // 10**9}', '{"sec": "x"').encode())):
            writer.add_message(channel, START + n, data, START + n)
        writer.finish()
    with refused(InputError, 'E-MESSAGE-DAMAGED', path, 'image 0', '/a'):
        list(open_frames(path))


def test_a_message_in_json_is_limited():
    with refused(InputError, 'E-MESSAGE-TOO-LARGE', '32 MB'):
        message_of('foxglove.RawImage', 'json', b'[' + b'[],' * 12_000_000)


# a bag with camera_info ------------------------------------------------------------------------

def messages_of(path):
    with path.open('rb') as file:
        return [(schema.name, schema.encoding, schema.data, channel.topic,
                 channel.message_encoding, message.log_time, message.data)
                for schema, channel, message in make_reader(file).iter_messages()]


@pytest.mark.parametrize('encoding', ['protobuf', 'json'])
@pytest.mark.parametrize('name', ['CompressedImage', 'CompressedVideo'])
def test_other_encodings_stay_as_they_are_in_a_bag_with_camera_info(tmp_path, name, encoding):
    source = write_foxglove(tmp_path / 'drive.mcap', name, encoding)
    check_bag(source, '/cam/image', tmp_path / 'out')
    assert write_bag(source, '/cam/image', LENS, tmp_path / 'out') == 20
    before = [each for each in messages_of(source) if each[3] != '/cam/camera_info']
    after = messages_of(tmp_path / 'out' / 'out.mcap')
    assert [each for each in after if each[3] != '/cam/camera_info'] == before
    topic, info = first_camera_info(tmp_path / 'out')
    assert topic == '/cam/camera_info' and info.k.tolist() == LENS.matrix.ravel().tolist()
    assert info.header.frame_id == 'camera' and info.header.stamp.sec == START // 10**9
    assert load_camera(tmp_path / 'out').camera == LENS
    assert brightness(open_frames(tmp_path / 'out')) == list(range(20))


def test_a_video_of_ros_gets_camera_info(tmp_path):
    bag = write_packets(tmp_path / 'bag', encoded(levels()), PACKET, 'h264',
                        topic='/cam/image_raw/ffmpeg')
    assert write_bag(bag, '/cam/image_raw/ffmpeg', LENS, tmp_path / 'out') == 20
    topic, info = first_camera_info(tmp_path / 'out')
    assert topic == '/cam/camera_info' and info.header.stamp.sec == START // 10**9
    assert info_of(LENS).k.tolist() == info.k.tolist()
