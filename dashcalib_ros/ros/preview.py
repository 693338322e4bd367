# SPDX-License-Identifier: Apache-2.0
"""Pictures for people: tracks, mask and state, and the picture without distortion.

They are drawn and published in a thread of their own while someone subscribes.
"""
from __future__ import annotations

import array
import os
import queue
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from rclpy.publisher import Publisher
from sensor_msgs.msg import CompressedImage

from dashcalib_ros.arrays import GreyImage, Mask
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.remap import rectify
from dashcalib_ros.detect.detection import Detection
from dashcalib_ros.detect.estimator import TrackedPoints
from dashcalib_ros.ros.endpoints import Endpoints
from dashcalib_ros.ros.settings import NodeConfig

# of the pictures as JPEG; 95 takes twice the space
QUALITY = 80
# of the drawing thread: the node's other work comes first
NICE = 10
# of the time between two pictures; images do not come exactly on time
EARLY = 0.1
# blue, green, red
TRACK, INK = (90, 230, 90), (255, 255, 255)
# added to the ego vehicle's: white and black places become red, too
TINT = (-80, -80, 60)
FONT = cv2.FONT_HERSHEY_SIMPLEX
# binary digits after the point that cv2 draws with
SHIFT = 4


@dataclass(frozen=True)
class Picture:
    """An image with its message's header, and what was tracked and masked in it.

    valid: (h, w) of the image, or of the image resized; None: no ego vehicle is known.
    """

    header: Any
    image: GreyImage
    points: TrackedPoints
    valid: Mask | None


class Preview:
    """Publishes ~/overlay/compressed and ~/rectified/compressed.

    Only the newest image waits for the drawing thread: neither the background thread, which calls
    take(), nor the image callback ever waits for it. published: how many pictures, of both kinds.
    """

    def __init__(self, endpoints: Endpoints, config: NodeConfig, view: str,
                 failed: Callable[[Exception], None]) -> None:
        """view: the setting `rectified`. failed: called with what a drawing raised."""
        self.published = 0
        self._overlay, self._rectified = (
            endpoints.publisher(f'~/{name}/compressed') for name in ('overlay', 'rectified'))
        self._period_s = (1 - EARLY) / config.preview_rate
        self._failed = failed
        self._view = view
        # used by the background thread only
        self._due = 0.0
        # the newest picture only; None ends the thread
        self._waiting: queue.Queue[Picture | None] = queue.Queue(1)
        self._state: tuple[str, Camera | None] = ('', None)
        self._thread = threading.Thread(target=self._draw, name='preview', daemon=True)
        endpoints.at_end(self.close)

    def take(self, header: Any, image: GreyImage, found: Detection) -> None:
        """Have an image drawn if someone subscribes and it is due; one that waits is dropped."""
        now = time.monotonic()
        if now < self._due:
            return
        self._due = now + self._period_s
        if self._overlay.get_subscription_count() or self._rectified.get_subscription_count():
            if not self._thread.is_alive():
                self._thread.start()
            self._put(Picture(header, image, found.points(), found.valid()))

    def show_state(self, text: str, camera: Camera | None) -> None:
        """Take the state that the overlay shows, and the camera in use."""
        self._state = text, camera

    def close(self) -> None:
        """End the thread."""
        self._put(None)
        if self._thread.is_alive():
            self._thread.join(timeout=10)

    def _put(self, picture: Picture | None) -> None:
        with suppress(queue.Empty):
            self._waiting.get_nowait()
        with suppress(queue.Full):  # of two threads that put, one comes first
            self._waiting.put_nowait(picture)

    def _draw(self) -> None:
        with suppress(OSError, AttributeError):
            # on Linux, of this thread only
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICE)
        while (picture := self._waiting.get()) is not None:
            try:
                self._publish(picture, *self._state)
            except Exception as error:
                self._failed(error)

    def _publish(self, picture: Picture, text: str, camera: Camera | None) -> None:
        if self._overlay.get_subscription_count():
            self._send(self._overlay, picture, overlay(picture, text))
        fits = camera is not None and camera.image_size == picture.image.shape[::-1]
        if camera is not None and fits and self._rectified.get_subscription_count():
            self._send(self._rectified, picture, rectify(picture.image, camera, self._view))

    def _send(self, publisher: Publisher, picture: Picture, drawn: npt.NDArray[np.uint8]) -> None:
        _, data = cv2.imencode('.jpg', drawn, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        message: Any = CompressedImage(header=picture.header, format='jpeg',
                                       data=array.array('B', data.tobytes()))
        publisher.publish(message)
        self.published += 1


def overlay(picture: Picture, text: str) -> npt.NDArray[np.uint8]:
    """Return (h, w, 3), bgr: the image with tracks, the ego vehicle tinted, and a line of text."""
    drawn: Any = cv2.cvtColor(picture.image, cv2.COLOR_GRAY2BGR)
    if picture.valid is not None:
        hidden = cv2.resize((~picture.valid).astype(np.uint8), drawn.shape[1::-1],
                            interpolation=cv2.INTER_NEAREST) > 0
        drawn[hidden] = np.clip(drawn[hidden].astype(np.int16) + TINT, 0, 255)
    thickness = max(1, round(drawn.shape[1] / 640))
    before, now = (np.rint(xy * (1 << SHIFT)).astype(np.int32)
                   for xy in (picture.points.before, picture.points.now))
    cv2.polylines(drawn, list(np.stack([before, now], axis=1)), False, TRACK, thickness,
                  cv2.LINE_AA, SHIFT)
    for x, y in now.tolist():
        cv2.circle(drawn, (x, y), thickness << (SHIFT + 1), TRACK, -1, cv2.LINE_AA, SHIFT)
    if text:
        _write(drawn, text)
    return np.asarray(drawn)


def _write(drawn: Any, text: str) -> None:
    # cv2's fonts have ASCII only
    text = text.replace('°', ' deg').replace('±', '+-').encode('ascii', 'replace').decode()
    height, width = drawn.shape[:2]
    margin = max(4, width // 100)
    (needed, _), _ = cv2.getTextSize(text, FONT, 1.0, 1)
    scale = min(width / 1100, (width - 2 * margin) / needed)
    thickness = max(1, round(1.6 * scale))
    (_, tall), below = cv2.getTextSize(text, FONT, scale, thickness)
    bar = min(height, tall + below + margin)
    drawn[height - bar:] //= 4
    cv2.putText(drawn, text, (margin, height - below - margin // 2), FONT, scale, INK, thickness,
                cv2.LINE_AA)
