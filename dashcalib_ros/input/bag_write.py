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
from rosbags.typesys import Stores, get_typestore

from dashcalib_ros.camera import Camera, ros_camera
from dashcalib_ros.camera.camera_info import SAME, RosCamera
from dashcalib_ros.errors import InputError, OutputError
from dashcalib_ros.input.bag_read import WITHIN_LIMIT, Reader2, unpacked
from dashcalib_ros.input.bag_storage import open_bag
from dashcalib_ros.input.source import METADATA
from dashcalib_ros.limits import YAML_BYTES, parse_yaml, read_text
from dashcalib_ros.whole_files import temporary_folder

CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
REPAIR = "repair it first ('ros2 bag convert', 'mcap recover', 'ros2 bag reindex')"


def camera_info_topic(image_topic: str) -> str:
    """Return the camera_info topic that image_transport expects for an image topic."""
    base = image_topic.removesuffix('/compressed')
    return f'{base.rpartition("/")[0]}/camera_info'


def first_camera_info(path: Path, topic: str | None = None) -> tuple[str, Any]:
    """Return the topic of a bag's camera_info, and the first message on it.

    topic: that topic, or the camera's image topic; needed only where several cameras have
    camera_info. Raises InputError, OSError.
    """
    bag = open_bag(path)
    infos = [each.name for each in bag.topics if each.msgtype == CAMERA_INFO and each.count]
    if topic is None:
        wanted = {camera_info_topic(each.name) for each in bag.topics if each.is_image}
        found = [name for name in infos if name in wanted] or infos
    else:
        wanted = {f'/{topic.strip("/")}', camera_info_topic(f'/{topic.strip("/")}')}
        found = [name for name in infos if f'/{name.strip("/")}' in wanted]
    if len(found) != 1:
        there = f'it has {", ".join(infos)}' if infos else 'there is none'
        raise InputError(f'{path}: no one camera_info belongs to '
                         f'{topic or "its images"}: {there}; name its topic, as in '
                         f'{path}:{(infos or ["/camera/camera_info"])[0]}, or give a file')
    record = next(bag.records(found, lambda _: None), None)
    if record is None:
        raise InputError(f'{path} is damaged: there is no message on {found[0]}; {REPAIR}')
    return found[0], record.message()


def check_bag(source: str | os.PathLike[str], image_topic: str | None,
              out: str | os.PathLike[str]) -> None:
    """Check that write_bag() will succeed, before a long calibration and not after it.

    image_topic: None when the source is no bag. Raises InputError or OutputError.
    """
    path = Path(out).absolute()
    _check_free(path)
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
    types = get_typestore(Stores.ROS2_JAZZY)
    count = 0
    with _opened(source, image_topic) as reader, new_bag(Path(out)) as writer:
        kept = [each for each in reader.connections if each.topic != topic]
        copies = {each.id: _declared(writer, each) for each in kept}
        infos = writer.add_connection(topic, CAMERA_INFO, typestore=types)
        for connection, stamp_ns, raw in _messages(reader, kept, source):
            writer.write(copies[connection.id], stamp_ns, raw)
            if connection.topic == image_topic:
                image: Any = types.deserialize_cdr(raw, connection.msgtype)
                info = _camera_info(types.types, ros, image.header)
                writer.write(infos, stamp_ns, types.serialize_cdr(info, CAMERA_INFO))
                count += 1
    return count


@contextmanager
def new_bag(path: Path) -> Iterator[Writer]:
    """Give the writer of an MCAP bag, a folder that appears when all went well.

    Raises OutputError when it exists or cannot be written.
    """
    path = path.absolute()
    _check_free(path)
    try:
        with temporary_folder(path.parent) as draft:
            # rosbags names the file inside after the folder: it has its last name already
            with Writer(draft / path.name, version=9,
                        storage_plugin=StoragePlugin.MCAP) as writer:
                yield writer
            (draft / path.name).rename(path)
    except (OSError, WriterError) as error:
        raise _unwritable(path, error) from error


def _check_free(path: Path) -> None:
    if os.path.lexists(path):
        raise OutputError(f'{path} exists: choose another place for the bag or remove it')


def _unwritable(path: Path, error: Exception) -> OutputError:
    return OutputError(f'{path} cannot be written ({error}): check the path, its permissions and '
                       f'the room on that disk')


def _messages(reader: Reader2, connections: list[Connection], source: str | os.PathLike[str]
              ) -> Iterator[tuple[Connection, int, bytes]]:
    try:
        yield from reader.messages(connections)
    except Exception as error:  # a damaged file makes rosbags raise nearly anything
        raise InputError(f'{source} is damaged, no bag is made of it: {REPAIR}') from error


def _declared(writer: Writer, connection: Connection) -> Connection:
    """Declare a topic as in the source, with the source's message definition if it has one."""
    ext: Any = connection.ext
    common: dict[str, Any] = {'serialization_format': ext.serialization_format,
                              'offered_qos_profiles': ext.offered_qos_profiles}
    if connection.msgdef.data and connection.digest:
        return writer.add_connection(connection.topic, connection.msgtype,
                                     msgdef=connection.msgdef.data, rihs01=connection.digest,
                                     **common)
    types = get_typestore(Stores.ROS2_JAZZY)
    if connection.msgtype not in types.types:
        raise InputError(f'the bag does not say what a {connection.msgtype} is (topic '
                         f"{connection.topic}): convert it on a machine that has that type with "
                         f"'ros2 bag convert'")
    return writer.add_connection(connection.topic, connection.msgtype, typestore=types, **common)


@contextmanager
def _opened(source: str | os.PathLike[str], image_topic: str | None) -> Iterator[Reader2]:
    if image_topic is None:
        raise InputError(f'{source} is no bag: only of a bag a bag can be made')
    path = Path(source)
    if path.suffix == '.bag' or (path.is_dir() and not any(path.glob('*.yaml'))
                                 and any(path.glob('*.bag'))):
        raise InputError(f'{source} is a ROS 1 bag: convert it first (rosbags-convert)')
    with ExitStack() as opened:
        try:
            _check_limits(path)
            opened.enter_context(WITHIN_LIMIT)
            reader = opened.enter_context(Reader2(path))
        except Exception as error:  # a damaged file makes rosbags raise nearly anything
            raise InputError(f'{source} cannot be copied ({error}): {REPAIR}') from error
        topic = camera_info_topic(image_topic)
        wrong = [each.msgtype for each in reader.connections
                 if each.topic == topic and each.msgtype != CAMERA_INFO]
        if wrong:
            raise InputError(f'{source} has {wrong[0]} on {topic}, where camera_info belongs: '
                             f'rename that topic')
        yield reader


def _check_limits(path: Path) -> None:
    """Raise InputError where rosbags would have to read or unpack more than limits allow."""
    if path.is_dir():
        parse_yaml(read_text(path / METADATA, YAML_BYTES), str(path / METADATA))
    for file in open_bag(path).files:
        with unpacked(file, _refuse):
            pass


def _refuse(damage: str) -> None:
    raise InputError(damage)


def _camera_info(types: Any, c: RosCamera, header: Any) -> Any:
    width, height = c.image_size
    return types[CAMERA_INFO](
        header=header, height=height, width=width, distortion_model=c.distortion_model,
        d=np.array(c.d), k=np.array(c.k), r=np.array(c.r), p=np.array(c.p),
        binning_x=0, binning_y=0,
        roi=types['sensor_msgs/msg/RegionOfInterest'](
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False))
