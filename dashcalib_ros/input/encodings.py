# SPDX-License-Identifier: Apache-2.0
"""The bytes of a bag's message -> the message, in the shape of ROS's, whatever encoded it.

Foxglove's pictures and calibrations (protobuf, JSON, or messages of foxglove_msgs) become what
sensor_msgs has for them. A video's packets get a header and stay packets: input/packets.py.
"""
from __future__ import annotations

import base64
import json
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from types import SimpleNamespace
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from dashcalib_ros.errors import InputError
from dashcalib_ros.limits import JSON_MESSAGE_BYTES, YAML_BYTES

CDR, ROS1, PROTOBUF, JSON = 'cdr', 'ros1', 'protobuf', 'json'
ENCODINGS = (CDR, ROS1, PROTOBUF, JSON)
# what is a picture, or a packet of a video
PICTURES = ('sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage',
            'ffmpeg_image_transport_msgs/msg/FFMPEGPacket') + tuple(
    f'{package}{name}' for package in ('foxglove.', 'foxglove_msgs/msg/')
    for name in ('CompressedImage', 'RawImage', 'CompressedVideo'))
CAMERA_INFOS = ('sensor_msgs/msg/CameraInfo', 'foxglove.CameraCalibration',
                'foxglove_msgs/msg/CameraCalibration')
# messages that are not part of ROS itself
FURTHER = {
    'foxglove_msgs/msg/CompressedImage':
        'time timestamp\nstring frame_id\nuint8[] data\nstring format\n',
    'foxglove_msgs/msg/CompressedVideo':
        'time timestamp\nstring frame_id\nuint8[] data\nstring format\n',
    'foxglove_msgs/msg/RawImage':
        'time timestamp\nstring frame_id\nuint32 width\nuint32 height\nstring encoding\n'
        'uint32 step\nuint8[] data\n',
    'foxglove_msgs/msg/CameraCalibration':
        'time timestamp\nstring frame_id\nuint32 width\nuint32 height\nstring distortion_model\n'
        'float64[] D\nfloat64[9] K\nfloat64[9] R\nfloat64[12] P\n',
    'ffmpeg_image_transport_msgs/msg/FFMPEGPacket':
        'std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\n'
        'uint8 flags\nbool is_bigendian\nuint8[] data\n'}
# Foxglove's protobuf messages, for bags that leave out the schema: field, number, type
_FIELD = descriptor_pb2.FieldDescriptorProto
_STAMP = ('timestamp', 1, _FIELD.TYPE_MESSAGE)
_FOXGLOVE: Mapping[str, Sequence[tuple[str, int, int]]] = {
    'CompressedImage': (_STAMP, ('data', 2, _FIELD.TYPE_BYTES), ('format', 3, _FIELD.TYPE_STRING),
                        ('frame_id', 4, _FIELD.TYPE_STRING)),
    'CompressedVideo': (_STAMP, ('frame_id', 2, _FIELD.TYPE_STRING),
                        ('data', 3, _FIELD.TYPE_BYTES), ('format', 4, _FIELD.TYPE_STRING)),
    'RawImage': (_STAMP, ('width', 2, _FIELD.TYPE_FIXED32), ('height', 3, _FIELD.TYPE_FIXED32),
                 ('encoding', 4, _FIELD.TYPE_STRING), ('step', 5, _FIELD.TYPE_FIXED32),
                 ('data', 6, _FIELD.TYPE_BYTES), ('frame_id', 7, _FIELD.TYPE_STRING)),
    'CameraCalibration': (
        _STAMP, ('width', 2, _FIELD.TYPE_FIXED32), ('height', 3, _FIELD.TYPE_FIXED32),
        ('distortion_model', 4, _FIELD.TYPE_STRING), ('D', 5, _FIELD.TYPE_DOUBLE),
        ('K', 6, _FIELD.TYPE_DOUBLE), ('R', 7, _FIELD.TYPE_DOUBLE), ('P', 8, _FIELD.TYPE_DOUBLE),
        ('frame_id', 9, _FIELD.TYPE_STRING))}


def message_of(kind: str, encoding: str, raw: bytes, schema: bytes = b'') -> Any:
    """Return the message that bytes are.

    kind: its type. encoding: one of ENCODINGS; topics with another one are not read. schema: a
    bag's own, of protobuf.

    ROS's messages are read by ROS's own definitions, not the bag's: sensor_msgs' images never
    changed, and a bag with an invalid definition of another type can still be read. Raises nearly
    anything for bytes that are damaged.
    """
    if encoding == PROTOBUF:
        message = _protobuf_class(kind, schema).FromString(raw)
        return _of_foxglove(kind, partial(getattr, message))
    if encoding == JSON:
        if len(raw) > JSON_MESSAGE_BYTES:
            raise InputError('E-MESSAGE-TOO-LARGE', f'it has more than '
                             f'{JSON_MESSAGE_BYTES / 2**20:.0f} MB of JSON: record it in another '
                             f'encoding')
        return _of_foxglove(kind, json.loads(raw).__getitem__)
    if encoding == ROS1:
        return _as_ros(types(Stores.ROS1_NOETIC).deserialize_ros1(raw, kind))
    return _as_ros(types(Stores.ROS2_JAZZY).deserialize_cdr(raw, kind))


def _of_foxglove(kind: str, value_of: Callable[[str], Any]) -> Any:
    """Return one of Foxglove's messages. value_of: a field, as the encoding has it."""
    fields: dict[str, Any] = {}
    for name, _, field in _FOXGLOVE[kind.rpartition('.')[2]]:
        value = value_of(name)
        if field == _FIELD.TYPE_BYTES:
            value = (base64.b64decode(value, validate=True) if isinstance(value, str) else
                     bytes(memoryview(value)))
        elif field == _FIELD.TYPE_FIXED32:
            value = int(value)
        elif field == _FIELD.TYPE_DOUBLE:
            value = [float(each) for each in value]
        fields[name] = str(value) if field == _FIELD.TYPE_STRING else value
    return _as_ros(SimpleNamespace(**fields))


@lru_cache
def types(store: Stores) -> Typestore:
    """Return ROS's messages and those of FURTHER."""
    found = get_typestore(store)
    for name, text in FURTHER.items():
        found.register(get_types_from_msg(text, name))
    return found


@lru_cache(maxsize=32)
def _protobuf_class(name: str, schema: bytes) -> Any:
    """Return the class of a bag's protobuf messages. schema: a FileDescriptorSet, or nothing."""
    if len(schema) > YAML_BYTES:
        raise InputError('E-MESSAGE-TOO-LARGE', 'its schema is too large: record it in another '
                         'encoding')
    pool = descriptor_pool.DescriptorPool()
    files = {file.name: file for file in
             (*descriptor_pb2.FileDescriptorSet.FromString(schema).file, *([] if schema else [
                 _foxglove_file()]))}
    stamp = descriptor_pb2.FileDescriptorProto.FromString(timestamp_pb2.DESCRIPTOR.serialized_pb)
    files.setdefault(stamp.name, stamp)
    # a file comes after those that it imports
    while ready := [file for file in files.values() if not files.keys() & set(file.dependency)]:
        for file in ready:
            pool.AddSerializedFile(files.pop(file.name).SerializeToString())
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


def _foxglove_file() -> descriptor_pb2.FileDescriptorProto:
    file = descriptor_pb2.FileDescriptorProto(
        name='foxglove.proto', package='foxglove', syntax='proto3',
        dependency=[timestamp_pb2.DESCRIPTOR.name])
    for name, fields in _FOXGLOVE.items():
        message = file.message_type.add(name=name)
        for field, number, kind in fields:
            message.field.add(
                name=field, number=number, type=kind,  # type: ignore[arg-type]
                label=_FIELD.LABEL_REPEATED if kind == _FIELD.TYPE_DOUBLE else
                _FIELD.LABEL_OPTIONAL,
                type_name='.google.protobuf.Timestamp' if kind == _FIELD.TYPE_MESSAGE else None)
    return file


def _as_ros(message: Any) -> Any:
    """Return a message with what sensor_msgs has and Foxglove has not."""
    if not hasattr(message, 'timestamp'):
        return message
    fields = {name: getattr(message, name) for name in (
        'width', 'height', 'encoding', 'step', 'data', 'format', 'distortion_model',
        *'dkrpDKRP') if hasattr(message, name)}
    if 'distortion_model' in fields:
        fields.update(binning_x=0, binning_y=0, roi=SimpleNamespace(
            x_offset=0, y_offset=0, width=0, height=0))
    stamp = message.timestamp
    stamp = stamp if isinstance(stamp, Mapping) else {
        name: getattr(stamp, name, 0) for names in _TIMES for name in names}
    seconds, parts = (next((int(stamp[name]) for name in names if stamp.get(name)), 0)
                      for names in _TIMES)
    header = SimpleNamespace(stamp=SimpleNamespace(sec=seconds, nanosec=parts),
                             frame_id=str(getattr(message, 'frame_id', '')))
    return SimpleNamespace(header=header, is_bigendian=0, **fields)


# of ROS 2, of ROS 1, of protobuf and of JSON
_TIMES = ('sec', 'secs', 'seconds'), ('nanosec', 'nsecs', 'nanos', 'nsec')
