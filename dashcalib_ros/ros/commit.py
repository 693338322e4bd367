# SPDX-License-Identifier: Apache-2.0
"""A calibration for the camera driver: its service set_camera_info."""
from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from rclpy.node import Node
from sensor_msgs.msg import CameraInfo
from sensor_msgs.srv import SetCameraInfo

from dashcalib_ros.ros.endpoints import Endpoints
from dashcalib_ros.ros.images import ImageInput
from dashcalib_ros.ros.interface import SET_CAMERA_INFO

# s between two looks whether the driver has answered
LOOK_S = 0.1


class Commit:
    """Sends a calibration to the driver's service without waiting for it; logs the outcome.

    There is one warning if the driver has no service, does not answer, or dies meanwhile.
    """

    def __init__(self, endpoints: Endpoints, info: CameraInfo, timeout_s: float,
                 names: Callable[[], Sequence[str]]) -> None:
        """names: of services, of which the first that there is is called.

        They are looked up again and again: a publisher may be seen before its node's name is.
        """
        self._node = endpoints.node
        self._log, self._info, self._timeout_s = endpoints.log, info, timeout_s
        self._names, self._clients = names, dict[str, Any]()
        self._name = ''
        self._answer: Any = None
        self._deadline = time.monotonic() + timeout_s
        self._end_timer = endpoints.timer(LOOK_S, self._look)
        endpoints.at_end(self.end)

    def end(self) -> None:
        """Wait for an answer no longer."""
        self._end_timer()
        while self._clients:
            self._node.destroy_client(self._clients.popitem()[1])

    def _look(self) -> None:
        names = self._names() if self._answer is None else ()
        for name in names:
            if name not in self._clients:
                self._clients[name] = self._node.create_client(SetCameraInfo, name)
        for name in names:
            client = self._clients[name]
            if self._answer is None and client.service_is_ready():
                self._name = name
                self._answer = client.call_async(SetCameraInfo.Request(camera_info=self._info))
        answered = self._answer is not None and self._answer.done()
        if not answered and time.monotonic() < self._deadline:
            return
        name = self._name or ' or '.join(names)
        self.end()
        if self._answer is None:
            trouble = f'there is no service {name}'
        elif not answered:
            trouble = f'{name} did not answer within {self._timeout_s:g} s'
        elif self._answer.exception() is not None:
            trouble = f'{name} failed: {self._answer.exception()}'
        elif self._answer.result().success:
            self._log.info(f'{name} accepted the calibration')
            return
        else:
            trouble = f'{name} refused: {self._answer.result().status_message}'
        self._log.warning(f'{trouble}: the camera driver does not have the calibration; start a '
                          f'driver with that service, or set commit to false')


def driver_services(node: Node, images: ImageInput) -> tuple[str, ...]:
    """Return where the driver's set_camera_info may be: where it was remapped to, if it was.

    Else the publisher's own, as camera_info_manager names it, the one beside the images, and that
    of this node's namespace.
    """
    name = SET_CAMERA_INFO
    own = node.resolve_service_name(name)
    if own != node.resolve_service_name(name, only_expand=True):
        return (own,)
    drivers = [f'{each}/{name}' for each in images.publishers if each.startswith('/')]
    beside = f'{images.base.rpartition("/")[0]}/{name}'
    return tuple(dict.fromkeys((*drivers, beside, own)))
