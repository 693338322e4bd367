"""Gives an accepted calibration to the camera driver: the client of set_camera_info."""
from __future__ import annotations

import time
from typing import Any

from rclpy.clock import Clock
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo
from sensor_msgs.srv import SetCameraInfo

LOOK_S = 0.1


class Commit:
    """Calls the driver's service without waiting for it; logs the outcome.

    There is one warning if the driver has no service, does not answer, or dies meanwhile.
    """

    def __init__(self, node: Node, timeout_s: float, clock: Clock) -> None:
        self._node = node
        self._timeout_s = timeout_s
        self._name = node.resolve_service_name('set_camera_info')
        self._client = node.create_client(SetCameraInfo, 'set_camera_info')
        self._timer = node.create_timer(LOOK_S, self._look, clock=clock, autostart=False)
        self._waiting: CameraInfo | None = None
        self._answer: Any = None
        self._deadline = 0.0

    def call(self, info: CameraInfo) -> None:
        """Send a calibration; an earlier call that is not answered yet is cancelled."""
        self._forget()
        self._waiting = info
        self._deadline = time.monotonic() + self._timeout_s
        self._timer.reset()

    def _look(self) -> None:
        if self._answer is None and self._client.service_is_ready():
            request = SetCameraInfo.Request(camera_info=self._waiting)
            self._answer = self._client.call_async(request)
        if self._answer is not None and self._answer.done():
            self._report(self._answer)
            self._forget()
        elif time.monotonic() > self._deadline:
            trouble = (f'there is no service {self._name}' if self._answer is None else
                       f'{self._name} did not answer within {self._timeout_s:g} s')
            self._node.get_logger().warning(
                f'{trouble}: the camera driver does not have the calibration; start a driver with '
                f'that service, or set commit to false')
            self._forget()

    def _report(self, answer: Any) -> None:
        if answer.exception() is not None:
            text = f'{self._name} failed: {answer.exception()}'
        elif answer.result().success:
            self._node.get_logger().info(f'{self._name} took the calibration')
            return
        else:
            text = f'{self._name} refused: {answer.result().status_message}'
        self._node.get_logger().warning(text)

    def _forget(self) -> None:
        if self._answer is not None and not self._answer.done():
            self._client.remove_pending_request(self._answer)
        self._answer = self._waiting = None
        self._timer.cancel()
