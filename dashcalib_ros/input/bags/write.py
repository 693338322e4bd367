"""Frames -> a ROS 2 bag."""
from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Literal

import cv2
import numpy as np
from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
from rosbags.typesys import Stores, get_typestore

from dashcalib_ros.errors import OutputError
from dashcalib_ros.input.frame import Frame

_FORMATS = {'jpeg': '.jpg', 'png': '.png'}


class BagWriter:
    """Writes frames into a new ROS 2 bag (a folder with an MCAP file); use it in a with statement.

    path: of the bag's folder; it must not exist yet, and it appears only when all went well.
    topic: taken as it is: for compressed images ROS expects it to end in /compressed.
    frame_id: of every header; the stamps are the frames'.
    compressed: None for mono8 Images, 'jpeg' or 'png' for CompressedImages.
    quality: of the JPEG, 1 to 100.

    Raises OutputError when the bag exists or cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str], topic: str, frame_id: str = 'camera',
                 compressed: Literal['jpeg', 'png'] | None = None, quality: int = 90) -> None:
        if compressed is not None and compressed not in _FORMATS:
            raise OutputError(f'compressed must be jpeg, png or None, not {compressed!r}')
        self._path = Path(path).absolute()
        self._topic = topic
        self._frame_id = frame_id
        self._compressed = compressed
        self._quality = quality
        self._types = get_typestore(Stores.ROS2_JAZZY)

    def __enter__(self) -> BagWriter:
        if self._path.exists():
            raise OutputError(f'{self._path} exists: choose another place or remove it')
        kind = 'sensor_msgs/msg/' + ('CompressedImage' if self._compressed else 'Image')
        draft: Path | None = None
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._draft = draft = Path(tempfile.mkdtemp(prefix='.writing-', dir=self._path.parent))
            # rosbags names the file inside after the folder: it has its last name already
            self._writer = Writer(self._draft / self._path.name, version=9,
                                  storage_plugin=StoragePlugin.MCAP)
            self._writer.open()
            self._connection: Connection = self._writer.add_connection(
                self._topic, kind, typestore=self._types)
        except (OSError, WriterError) as error:
            if draft is not None:
                shutil.rmtree(draft, ignore_errors=True)
            raise self._failed(error) from error
        return self

    def write(self, frame: Frame) -> None:
        """Append one frame, stamped frame.stamp_ns."""
        kinds = self._types.types
        seconds, nanoseconds = divmod(frame.stamp_ns, 10**9)
        header = kinds['std_msgs/msg/Header'](
            stamp=kinds['builtin_interfaces/msg/Time'](sec=seconds, nanosec=nanoseconds),
            frame_id=self._frame_id)
        if self._compressed:
            message = kinds['sensor_msgs/msg/CompressedImage'](
                header=header, format=f'mono8; {self._compressed} compressed mono8',
                data=self._encode(frame))
        else:
            width, height = frame.size
            message = kinds['sensor_msgs/msg/Image'](
                header=header, height=height, width=width, encoding='mono8', is_bigendian=0,
                step=width, data=np.ascontiguousarray(frame.image).reshape(-1))
        raw = self._types.serialize_cdr(message, self._connection.msgtype)
        try:
            self._writer.write(self._connection, frame.stamp_ns, raw)
        except (OSError, WriterError) as error:
            raise self._failed(error) from error

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        try:
            if kind is None:
                self._writer.close()
                (self._draft / self._path.name).rename(self._path)
            else:
                self._writer.abort()
        except (OSError, WriterError) as failure:
            if kind is None:
                raise self._failed(failure) from failure
        finally:
            shutil.rmtree(self._draft, ignore_errors=True)

    def _encode(self, frame: Frame) -> np.ndarray[tuple[int], np.dtype[np.uint8]]:
        assert self._compressed
        _, data = cv2.imencode(_FORMATS[self._compressed], frame.image,
                               [cv2.IMWRITE_JPEG_QUALITY, self._quality]
                               if self._compressed == 'jpeg' else [])
        return np.asarray(data, np.uint8).reshape(-1)

    def _failed(self, error: Exception) -> OutputError:
        return OutputError(f'{self._path} cannot be written ({error}): '
                           f'check the permissions and the room on that disk')
