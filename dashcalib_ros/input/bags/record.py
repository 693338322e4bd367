"""One message of a bag, as it is stored."""
from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from dashcalib_ros.errors import InputError
from dashcalib_ros.input.bags.unpack import unpack_zstd
from dashcalib_ros.limits import MESSAGE_BYTES

_ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'


@dataclass(frozen=True)
class Record:
    """A stored message.

    msgtype: as ROS 2 writes it (sensor_msgs/msg/Image), also for ROS 1.
    receive_ns: when the recorder got it, in nanoseconds.
    raw: serialised; ros1 tells how. Bags that compress each message have it compressed here.
    """

    topic: str
    msgtype: str
    receive_ns: int
    raw: bytes
    ros1: bool = False

    def message(self) -> Any:
        """Return the message itself; raises InputError when its bytes make none.

        The types are ROS's own, not the bag's: sensor_msgs' images never changed, and a bag with
        an invalid definition of another type can still be read.
        """
        try:
            if self.ros1:
                return _types(Stores.ROS1_NOETIC).deserialize_ros1(self.raw, self.msgtype)
            raw = self.raw
            if raw[:4] == _ZSTD_MAGIC:  # a CDR message never starts so
                raw = unpack_zstd(raw, MESSAGE_BYTES)
            return _types(Stores.ROS2_JAZZY).deserialize_cdr(raw, self.msgtype)
        except InputError as error:
            raise InputError(f'a message on {self.topic}: {error}') from error
        except Exception as error:  # rosbags lets struct.error, AssertionError ... out
            raise InputError(f'a damaged message on {self.topic}: record it again') from error


def ros2_type(name: str) -> str:
    """Return a message type as ROS 2 writes it: sensor_msgs/Image -> sensor_msgs/msg/Image."""
    package, slash, kind = name.partition('/')
    return f'{package}/msg/{kind}' if slash and '/' not in kind else name


@functools.lru_cache
def _types(store: Stores) -> Typestore:
    return get_typestore(store)
