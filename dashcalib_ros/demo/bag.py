"""A drive rendered into a ROS 2 bag."""
from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from dashcalib_ros.demo.drive import Drive

TOPIC = '/camera/image_raw'


def render_to_bag(drive: Drive, path: str | os.PathLike[str],
                  progress: Callable[[float], None] = lambda done: None) -> None:
    """Render a complete drive into a new ROS 2 bag, as mono8 Images.

    path: the bag's folder, which must not exist yet; it appears only when all went well.
    progress: called with the share that is rendered, 0 to 1. Raises OutputError or WorkerError.
    """
    from rosbags.typesys import Stores, get_typestore

    from dashcalib_ros.input.bag_write import new_bag
    store = get_typestore(Stores.ROS2_JAZZY)
    image, header, time = (store.types[name] for name in (
        'sensor_msgs/msg/Image', 'std_msgs/msg/Header', 'builtin_interfaces/msg/Time'))
    with new_bag(Path(path)) as writer:
        topic = writer.add_connection(TOPIC, image.__msgtype__, typestore=store)
        for frame in drive.frames(processes=2):
            seconds, nanoseconds = divmod(frame.stamp_ns, 10**9)
            width, height = frame.size
            message = image(
                header=header(stamp=time(sec=seconds, nanosec=nanoseconds), frame_id='camera'),
                height=height, width=width, encoding='mono8', is_bigendian=0, step=width,
                data=frame.image.reshape(-1))
            writer.write(topic, frame.stamp_ns, store.serialize_cdr(message, topic.msgtype))
            progress((frame.index + 1) / len(drive))
