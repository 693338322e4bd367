"""Pictures for people, drawn and published in a thread of their own while someone subscribes."""
from __future__ import annotations

import array
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CompressedImage

from dashcalib_ros.camera import Camera
from dashcalib_ros.ros.news import Picture
from dashcalib_ros.ros.pictures import Rectifier, overlay
from dashcalib_ros.ros.qos import make_publisher
from dashcalib_ros.ros.settings import NodeConfig

# a viewer wants the newest only; a reliable publisher reaches both kinds of subscribers
NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
# of the drawing thread: the node's other work comes first
NICE = 10
# of the time between two pictures; images do not come exactly on time
EARLY = 0.1


class Preview:
    """Publishes ~/overlay/compressed and ~/rectified/compressed.

    The detecting thread asks wanted() for each image and gives those that are to show(). Only the
    newest is kept, so that neither it nor the image callback ever waits for a drawing.
    published: how many pictures, of both kinds.
    """

    def __init__(self, node: Node, config: NodeConfig, rectified: str,
                 failed: Callable[[Exception], None]) -> None:
        """rectified: the setting of this name. failed: called with what a drawing raised."""
        self.published = 0
        self._overlay = make_publisher(node, CompressedImage, '~/overlay/compressed', NEWEST)
        self._rectified = make_publisher(node, CompressedImage, '~/rectified/compressed', NEWEST)
        self._period_s = (1 - EARLY) / config.preview_rate
        self._quality = config.preview_quality
        self._failed = failed
        self._rectifier = Rectifier(rectified)
        # used by the detecting thread only
        self._due = 0.0
        # guards _newest, _text, _camera and _closed
        self._changed = threading.Condition()
        self._newest: Picture | None = None
        self._text = ''
        self._camera: Camera | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._draw, name='preview', daemon=True)
        self._thread.start()

    def wanted(self) -> bool:
        """Return whether the next image is to be shown: someone subscribes, and it is due."""
        now = time.monotonic()
        if now < self._due:
            return False
        self._due = now + self._period_s
        return bool(self._overlay.get_subscription_count()
                    or self._rectified.get_subscription_count())

    def show(self, picture: Picture) -> None:
        """Take an image to draw; one that waits still is dropped."""
        with self._changed:
            self._newest = picture
            self._changed.notify()

    def tell(self, text: str, camera: Camera | None) -> None:
        """Take the state that the overlay shows, and the camera in use."""
        with self._changed:
            self._text, self._camera = text, camera

    def close(self) -> None:
        """End the thread."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join(timeout=10)

    def _draw(self) -> None:
        with suppress(OSError, AttributeError):
            # on Linux, of this thread only
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICE)
        while True:
            with self._changed:
                while self._newest is None and not self._closed:
                    self._changed.wait()
                if self._closed or self._newest is None:
                    return
                picture, self._newest = self._newest, None
                text, camera = self._text, self._camera
            try:
                self._publish(picture, text, camera)
            except Exception as error:
                self._failed(error)

    def _publish(self, picture: Picture, text: str, camera: Camera | None) -> None:
        if self._overlay.get_subscription_count():
            self._send(self._overlay, picture, overlay(picture.image, picture.view, text))
        fits = camera is not None and camera.image_size == picture.image.shape[::-1]
        if camera is not None and fits and self._rectified.get_subscription_count():
            self._send(self._rectified, picture, self._rectifier.rectified(picture.image, camera))

    def _send(self, publisher: Publisher, picture: Picture, drawn: npt.NDArray[np.uint8]) -> None:
        _, data = cv2.imencode('.jpg', drawn, [cv2.IMWRITE_JPEG_QUALITY, self._quality])
        message: Any = CompressedImage(header=picture.header, format='jpeg',
                                       data=array.array('B', data.tobytes()))
        publisher.publish(message)
        self.published += 1
