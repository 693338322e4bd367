"""A drive rendered into a ROS 2 bag."""
from __future__ import annotations

import os
from typing import Literal

from dashcalib_ros.demo.drive import Drive


def render_to_bag(drive: Drive, path: str | os.PathLike[str], processes: int = 2,
                  topic: str = '/camera/image_raw',
                  compressed: Literal['jpeg', 'png'] | None = None, quality: int = 90) -> None:
    """Render a complete drive into a new ROS 2 bag.

    path: the bag's folder, which must not exist yet. Raises OutputError or WorkerError.
    """
    from dashcalib_ros.input.bag_write import BagWriter
    with BagWriter(path, topic, compressed=compressed, quality=quality) as writer:
        for frame in drive.frames(processes=processes):
            writer.write(frame)
