# SPDX-License-Identifier: Apache-2.0
"""A copy of a bag with a camera_info for each image, and the camera_info that a bag has."""
from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
from rosbags.typesys import Stores

from dashcalib_ros.camera import Camera, ros_camera
from dashcalib_ros.camera.camera_info import RosCamera
from dashcalib_ros.camera.remap import SAME
from dashcalib_ros.errors import InputError, OutputError
from dashcalib_ros.input.bag_read import (
    Reader2,
    has_other_encodings,
    mcap_contents,
    record_of,
    refuse,
    unpacked,
    within_limit,
)
from dashcalib_ros.input.bag_storage import open_bag
from dashcalib_ros.input.encodings import CAMERA_INFOS, CDR, message_of
from dashcalib_ros.input.encodings import types as types_of
from dashcalib_ros.input.source import METADATA
from dashcalib_ros.limits import YAML_BYTES, parse_yaml, read_text
from dashcalib_ros.whole_files import temporary_folder

CAMERA_INFO = CAMERA_INFOS[0]
# what image_transport adds to the name of a topic
TRANSPORTS = ('compressed', 'ffmpeg', 'foxglove', 'zstd')
REPAIR = "repair the bag first ('ros2 bag convert', 'mcap recover', 'ros2 bag reindex')"


def base_topic(topic: str) -> str:
    """Return an image topic without the transport that image_transport adds to its name."""
    base, _, transport = topic.rpartition('/')
    return base if transport in TRANSPORTS else topic


def camera_info_topic(image_topic: str) -> str:
    """Return the camera_info topic that image_transport expects for an image topic."""
    return f'{base_topic(image_topic).rpartition("/")[0]}/camera_info'


def first_camera_info(path: Path, topic: str | None = None) -> tuple[str, Any]:
    """Return the topic of a bag's camera_info, and the first message on it.

    topic: that topic, or the camera's image topic; needed only where several cameras have
    camera_info. Raises InputError, OSError.
    """
    bag = open_bag(path)
    infos = list(dict.fromkeys(
        each.name for each in bag.topics if each.msgtype in CAMERA_INFOS and each.count))
    if topic is None:
        wanted = {camera_info_topic(each.name) for each in bag.topics if each.is_image}
        found = [name for name in infos if name in wanted] or infos
    else:
        wanted = {f'/{topic.strip("/")}', camera_info_topic(f'/{topic.strip("/")}')}
        found = [name for name in infos if f'/{name.strip("/")}' in wanted]
    if len(found) != 1:
        there = ', '.join(infos) if infos else 'none'
        raise InputError('E-BAG-CAMERA-INFO', f'{path} has no single camera_info topic for '
                         f'{topic or "its images"} (camera_info topics: {there}): specify one, as '
                         f'in {path}:{(infos or ["/camera/camera_info"])[0]}, or use a file')
    record = next(bag.records(found, lambda _: None), None)
    if record is None:
        raise InputError('E-BAG-DAMAGED',
                         f'{path} is damaged, no message on {found[0]} can be read: {REPAIR}')
    return found[0], record.message()


def check_bag(source: str | os.PathLike[str], image_topic: str | None,
              out: str | os.PathLike[str]) -> None:
    """Check that write_bag() will succeed, before a long calibration and not after it.

    image_topic: None when the source is not a bag. Raises InputError or OutputError.
    """
    path = Path(out).absolute()
    _check_free(path)
    if image_topic is not None and _is_mixed(Path(source)):
        _checked_topic(source, image_topic)
    else:
        with _opened(source, image_topic):
            pass
    try:
        with temporary_folder(path.parent) as draft:
            (draft / f'{path.name}.mcap').touch()  # so is the file in it called
    except OSError as error:
        raise _unwritable(path, error) from error


def write_bag(source: str | os.PathLike[str], image_topic: str, camera: Camera,
              out: str | os.PathLike[str], rectified: str = SAME) -> int:
    """Copy the bag and add a camera_info for each image of the topic; return how many.

    The copy is an MCAP bag with every message of the source as it was, except an older camera_info
    of that camera, which is left out. Each new one has its image's header and time of reception.
    out: the new bag's folder; it appears only when all went well. rectified: as ros_camera()'s.
    Raises InputError, OutputError.
    """
    topic, ros = camera_info_topic(image_topic), ros_camera(camera, rectified)
    if _is_mixed(Path(source)):
        return _write_mixed(Path(source), image_topic, ros, Path(out))
    types = types_of(Stores.ROS2_JAZZY)
    count = 0
    with _opened(source, image_topic) as reader, new_bag(Path(out)) as writer:
        kept = [each for each in reader.connections if each.topic != topic]
        copies = {each.id: _declared(writer, each) for each in kept}
        infos = writer.add_connection(topic, CAMERA_INFO, typestore=types)
        for connection, stamp_ns, raw in _messages(reader, kept, source):
            writer.write(copies[connection.id], stamp_ns, raw)
            if connection.topic == image_topic:
                image = message_of(connection.msgtype, CDR, bytes(raw))
                writer.write(infos, stamp_ns, _camera_info(ros, image.header))
                count += 1
    return count


def _is_mixed(source: Path) -> bool:
    """Return whether a bag has messages that rosbags cannot copy: MCAP takes any encoding."""
    try:
        files = open_bag(source).files
        return all(file.suffix == '.mcap' for file in files) and any(
            map(has_other_encodings, files))
    except (InputError, OSError):
        return False  # raised again where it is opened


def _write_mixed(source: Path, image_topic: str, ros: RosCamera, out: Path) -> int:
    """Write the same as write_bag() of a bag with other encodings, which stay as they are.

    The new bag is a folder with one MCAP file, without metadata.yaml: that has no place for them.
    """
    from mcap.writer import Writer as McapWriter
    topic, count = _checked_topic(source, image_topic), 0
    definition, _ = types_of(Stores.ROS2_JAZZY).generate_msgdef(CAMERA_INFO, ros_version=2)
    with _new_folder(out) as folder, (folder / f'{folder.name}.mcap').open('wb') as file:
        writer = McapWriter(file)
        writer.start(library='dashcalib_ros')
        infos = writer.register_channel(topic, CDR, writer.register_schema(
            CAMERA_INFO, 'ros2msg', definition.encode()))
        for path in open_bag(source).files:
            channels: dict[int, int] = {}
            for schema, channel, message in mcap_contents(path, refuse):
                if channel.topic == topic:
                    continue
                if channel.id not in channels:
                    channels[channel.id] = writer.register_channel(
                        channel.topic, channel.message_encoding, 0 if schema is None else
                        writer.register_schema(schema.name, schema.encoding, schema.data),
                        channel.metadata)
                writer.add_message(channels[channel.id], message.log_time, message.data,
                                   message.publish_time, message.sequence)
                if channel.topic == image_topic:
                    header = record_of(schema, channel, message).message().header
                    writer.add_message(infos, message.log_time, _camera_info(ros, header),
                                       message.log_time)
                    count += 1
        writer.finish()
    return count


@contextmanager
def new_bag(path: Path) -> Iterator[Writer]:
    """Give the writer of an MCAP bag, a folder that appears when all went well.

    Raises OutputError when it exists or cannot be written.
    """
    # rosbags makes the folder, and names the file inside after it
    with _new_folder(path, made=False) as folder, Writer(
            folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        yield writer


@contextmanager
def _new_folder(path: Path, made: bool = True) -> Iterator[Path]:
    """Give a folder that appears at a path when all went well. made: it is there already."""
    path = path.absolute()
    _check_free(path)
    try:
        with temporary_folder(path.parent) as draft:
            folder = draft / path.name
            if made:
                folder.mkdir()
            yield folder
            folder.rename(path)
    except (OSError, WriterError) as error:
        raise _unwritable(path, error) from error


def _check_free(path: Path) -> None:
    if os.path.lexists(path):
        raise OutputError('E-OUTPUT-EXISTS',
                          f'{path} already exists: choose another path for the bag, or remove it')


def _unwritable(path: Path, error: Exception) -> OutputError:
    return OutputError('E-OUTPUT-NOT-WRITABLE', f'{path} cannot be written ({error}): check the '
                       f'path, its permissions and the free disk space')


def _messages(reader: Reader2, connections: list[Connection], source: str | os.PathLike[str]
              ) -> Iterator[tuple[Connection, int, bytes]]:
    try:
        yield from reader.messages(connections)
    except Exception as error:  # a damaged file makes rosbags raise nearly anything
        raise InputError('E-BAG-DAMAGED',
                         f'{source} is damaged and cannot be copied: {REPAIR}') from error


def _declared(writer: Writer, connection: Connection) -> Connection:
    ext: Any = connection.ext
    common: dict[str, Any] = {'serialization_format': ext.serialization_format,
                              'offered_qos_profiles': ext.offered_qos_profiles}
    if connection.msgdef.data and connection.digest:
        return writer.add_connection(connection.topic, connection.msgtype,
                                     msgdef=connection.msgdef.data, rihs01=connection.digest,
                                     **common)
    types = types_of(Stores.ROS2_JAZZY)
    if connection.msgtype not in types.types:
        raise InputError('E-BAG-TYPE-UNKNOWN', f'the bag does not define the message type '
                         f'{connection.msgtype} (topic {connection.topic}): convert the bag with '
                         f"'ros2 bag convert' on a machine where that type is installed")
    return writer.add_connection(connection.topic, connection.msgtype, typestore=types, **common)


@contextmanager
def _opened(source: str | os.PathLike[str], image_topic: str | None) -> Iterator[Reader2]:
    if image_topic is None:
        raise InputError('E-BAG-REQUIRED',
                         f'{source} is not a bag, and a bag with camera_info can '
                         f'only be made from a bag: use a bag as input')
    path = Path(source)
    if path.suffix == '.bag' or (path.is_dir() and not any(path.glob('*.yaml'))
                                 and any(path.glob('*.bag'))):
        raise InputError('E-BAG-ROS1',
                         f'{source} is a ROS 1 bag: convert it first (rosbags-convert)')
    with ExitStack() as opened:
        try:
            _check_limits(path)
            opened.enter_context(within_limit())
            reader = opened.enter_context(Reader2(path))
        except Exception as error:  # a damaged file makes rosbags raise nearly anything
            raise InputError('E-BAG-DAMAGED',
                             f'{source} cannot be copied ({error}): {REPAIR}') from error
        _checked_topic(source, image_topic)
        yield reader


def _checked_topic(source: str | os.PathLike[str], image_topic: str) -> str:
    topic = camera_info_topic(image_topic)
    wrong = [each.msgtype for each in open_bag(Path(source)).topics
             if each.name == topic and each.msgtype not in CAMERA_INFOS]
    if wrong:
        raise InputError('E-BAG-TOPIC-TAKEN', f'{source} has {wrong[0]} messages on {topic}, the '
                         f'topic of camera_info: rename that topic')
    return topic


def _check_limits(path: Path) -> None:
    """Raise InputError where rosbags would have to read or unpack more than limits allow."""
    if path.is_dir():
        parse_yaml(read_text(path / METADATA, YAML_BYTES), str(path / METADATA))
    for file in open_bag(path).files:
        with unpacked(file, refuse):
            pass


def _camera_info(c: RosCamera, header: Any) -> bytes:
    store = types_of(Stores.ROS2_JAZZY)
    types: Any = store.types
    fields = {name: np.array(value) if isinstance(value, list) else value
              for name, value in vars(c).items()}
    info = types[CAMERA_INFO](
        header=types['std_msgs/msg/Header'](
            stamp=types['builtin_interfaces/msg/Time'](
                sec=int(header.stamp.sec), nanosec=int(header.stamp.nanosec)),
            frame_id=str(header.frame_id)),
        **fields, binning_x=0, binning_y=0,
        roi=types['sensor_msgs/msg/RegionOfInterest'](
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False))
    return bytes(store.serialize_cdr(info, CAMERA_INFO))
