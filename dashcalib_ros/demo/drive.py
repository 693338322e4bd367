# SPDX-License-Identifier: Apache-2.0
"""A drive through the town: frames by random access, and the truth about them."""
from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path

import cv2
import numpy as np

from dashcalib_ros.arrays import Floats, Floats32, GreyImage
from dashcalib_ros.demo.fisheye import FisheyeLens, WholeRaycaster
from dashcalib_ros.demo.lens import Lens
from dashcalib_ros.demo.overlay import Overlay
from dashcalib_ros.demo.parallel import render_parallel
from dashcalib_ros.demo.path import Course, course_of
from dashcalib_ros.demo.quads import QuadList, Quads
from dashcalib_ros.demo.raycast import Raycaster
from dashcalib_ros.demo.spec import DriveSpec
from dashcalib_ros.demo.town import Town, build_town
from dashcalib_ros.demo.traffic import Traffic
from dashcalib_ros.demo.vehicle import MARGIN_S, Ride, ride_of
from dashcalib_ros.input import Frame

# 2026-01-05 12:00:00 UTC; the first frame's stamp
START_NS = 1_767_614_400 * 10**9
# of the exposure, when the light is sampled
INSTANTS = (-1.0 / 3.0, 0.0, 1.0 / 3.0)
# s; a stabiliser's low pass over the camera's heading
STEADY_S = 0.5

AnyLens = Lens | FisheyeLens


class Drive:
    """A lens and a spec: every frame can be rendered on its own, in any process, the same."""

    def __init__(self, lens: AnyLens, spec: DriveSpec) -> None:
        self.lens = lens
        self.spec = spec
        self.course: Course = course_of(spec)
        self.ride: Ride = ride_of(self.course, spec)
        usable = self.ride.duration - 2.0 * MARGIN_S
        first = 0.0 if spec.mounting is None else spec.mounting.phase_s
        self.times: Floats = first + np.arange(
            math.floor((usable - first) * spec.rate) + 1) / spec.rate

    def __len__(self) -> int:
        return int(self.times.size)

    @property
    def truth(self) -> dict[str, float]:
        """Return the lens as a calibration should find it."""
        return self.lens.truth

    @cached_property
    def poses(self) -> Floats:
        """Return (n, 4, 4): world from camera (x right, y down, z forward), metres.

        With a rolling shutter these are the middle row's.
        """
        rotation, position = self.ride.camera_at(self.times + MARGIN_S)
        poses = np.tile(np.eye(4), (len(self), 1, 1))
        poses[:, :3, :3] = rotation
        poses[:, :3, 3] = position
        return poses

    @cached_property
    def yaw(self) -> Floats:
        """Return the car's heading at each frame (n,) in rad, left positive, not wrapped."""
        return self.ride.yaw_at(self.times + MARGIN_S)

    @cached_property
    def turn_centers(self) -> tuple[int, ...]:
        """Return the frame nearest to the middle of each turn."""
        if self.spec.kind != 'drive':
            return ()
        return tuple(round((self.ride.time_at(s) - MARGIN_S) * self.spec.rate)
                     for s in self.course.turn_s)

    @cached_property
    def overlay(self) -> Overlay:
        """Return what hides the world; its mask is the ego vehicle's truth."""
        spec = self.spec
        return Overlay(self.lens.width, self.lens.height, spec.bonnet, spec.pillar,
                       spec.timestamp, spec.seed)

    @cached_property
    def town(self) -> Town:
        """Return the static world (built on first use, about two seconds)."""
        return build_town(self.course, self.spec.seed)

    @cached_property
    def traffic(self) -> Traffic:
        """Return the cars that move."""
        return Traffic(self.course, self.ride, self.spec)

    @cached_property
    def raycaster(self) -> Raycaster | WholeRaycaster:
        """Return the renderer of this lens and town; a stabiliser needs wider pictures."""
        margin = self._margin_px
        lens = replace(self.lens, width=self.lens.width + 2 * margin, cx=self.lens.cx + margin)
        return (WholeRaycaster(lens, self.town.atlas) if isinstance(lens, FisheyeLens)
                else Raycaster(lens, self.town.atlas))

    @cached_property
    def crop_px(self) -> Floats:
        """Return how far the stabiliser moves its crop to the right in each frame, (n,) px.

        The crop follows what the camera sees: against each turn, until it reaches its limit.
        """
        most = self.spec.stabilised * self.lens.width
        keep, steady = math.exp(-1.0 / (self.spec.rate * STEADY_S)), self.yaw.copy()
        for index in range(1, len(self)):
            steady[index] += keep * (steady[index - 1] - steady[index])
        return np.clip(self.lens.fx * (self.yaw - steady), -most, most)

    @property
    def _margin_px(self) -> int:
        # what the resampling needs beyond the crop, too
        most = self.spec.stabilised * self.lens.width
        return math.ceil(most) + 2 if most > 0.0 else 0

    def stamp_ns(self, index: int) -> int:
        """Return a frame's time stamp in nanoseconds."""
        seconds = index / self.spec.rate
        if (own := self.spec.mounting) is not None:
            seconds = own.late_s + seconds * (1 + 1e-6 * own.clock_ppm)
        return START_NS + round(seconds * 1e9)

    @cached_property
    def shading(self) -> Floats32:
        """Return the share of the light that arrives, (height, width)."""
        y, x = np.indices((self.lens.height, self.lens.width), np.float32)
        square = ((x - self.lens.cx) ** 2 + (y - self.lens.cy) ** 2) / (
            0.25 * (self.lens.width ** 2 + self.lens.height ** 2))
        return np.asarray(1.0 - self.spec.vignetting * np.minimum(square, 1.0), np.float32)

    def row_poses(self, index: int, later_s: float = 0.0) -> tuple[Floats, Floats]:
        """Return the rotations (n, 3, 3) and positions (n, 3) m of a frame's rows.

        World from camera; n is the picture's height, or 1 without a rolling shutter. later_s:
        after the middle of the exposure.
        """
        time = self.times[index] + MARGIN_S + later_s
        rows = np.zeros(1)
        if self.spec.rolling_shutter_ms > 0.0:
            rows = np.arange(self.lens.height) / (self.lens.height - 1) - 0.5
        return self.ride.camera_at(time + rows * self.spec.rolling_shutter_ms / 1000.0)

    def frames(self, first: int = 0, last: int | None = None,
               processes: int = 1) -> Iterator[Frame]:
        """Yield frames first to last (not included), rendering them lazily.

        processes: how many render; more than 1 are spawned, and change nothing but the speed.
        """
        end = len(self) if last is None else min(last, len(self))
        if processes > 1:
            yield from render_parallel(partial(Drive, self.lens, self.spec), first, end,
                                       processes)
            return
        for index in range(first, end):
            yield self.frame(index)

    def frame(self, index: int) -> Frame:
        """Render one frame; the same picture whatever was rendered before."""
        if not 0 <= index < len(self):
            raise IndexError(f'frame {index} of {len(self)}')
        scene, exposure_s = self.scene(index), self.spec.exposure_ms / 1000.0
        instants = [share * exposure_s for share in INSTANTS] if exposure_s > 0.0 else [0.0]
        light = sum(self.raycaster.render(scene, *self.row_poses(index, later_s))
                    for later_s in instants)
        image = np.asarray(light, np.float32) / np.float32(len(instants))
        if self._margin_px:
            image = self._cropped(image, self._margin_px + float(self.crop_px[index]))
        return Frame(index, self.stamp_ns(index), self._expose(image, index))

    def scene(self, index: int) -> Quads:
        """Return the world's surfaces at a frame's time."""
        cars = QuadList()
        self.traffic.add_to(cars, self.times[index] + MARGIN_S, self.town.cars)
        return Quads.join([self.town.quads, cars.quads()]) if cars.rows else self.town.quads

    def _cropped(self, image: Floats32, left: float) -> Floats32:
        """Return the picture that begins at a column, which need not be a whole number."""
        return np.asarray(cv2.warpAffine(
            image, np.array([[1.0, 0.0, left], [0.0, 1.0, 0.0]]), self.lens.size,
            flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP), np.float32)

    def _expose(self, image: Floats32, index: int) -> GreyImage:
        """Turn light into grey levels as the camera's electronics would."""
        spec = self.spec
        rng = np.random.default_rng([spec.seed, 5, index])
        if spec.blur > 0.0:
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), spec.blur), np.float32)
        time = self.times[index]
        # slow and smooth, as automatic exposure is
        slow = math.sin(0.9 * time) + math.sin(2.3 * time + 1.0)
        image *= np.float32(1.0 + spec.flicker * slow)
        if spec.vignetting > 0.0:
            image *= self.shading
        if spec.night:
            image *= np.float32(0.11)
            image += np.float32(5.0)
        self.overlay.apply(image, self.stamp_ns(index))
        sigma = max(spec.noise, 4.0) if spec.night else spec.noise
        if sigma > 0.0:
            image += np.float32(sigma) * rng.standard_normal(image.shape, np.float32)
        grey: GreyImage = np.clip(np.rint(image), 0.0, 255.0).astype(np.uint8)
        if spec.jpeg_quality is not None:
            _, code = cv2.imencode('.jpg', grey, (cv2.IMWRITE_JPEG_QUALITY, spec.jpeg_quality))
            grey = np.asarray(cv2.imdecode(code, cv2.IMREAD_GRAYSCALE), np.uint8)
        return grey


def render(lens: Lens, spec: DriveSpec, processes: int = 1) -> Iterator[Frame]:
    """Yield all frames of a drive, rendered on demand."""
    return Drive(lens, spec).frames(processes=processes)


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
        topic = writer.add_connection('/camera/image_raw', image.__msgtype__, typestore=store)
        for frame in drive.frames(processes=2):
            seconds, nanoseconds = divmod(frame.stamp_ns, 10**9)
            width, height = frame.size
            message = image(
                header=header(stamp=time(sec=seconds, nanosec=nanoseconds), frame_id='camera'),
                height=height, width=width, encoding='mono8', is_bigendian=0, step=width,
                data=frame.image.reshape(-1))
            writer.write(topic, frame.stamp_ns, store.serialize_cdr(message, topic.msgtype))
            progress((frame.index + 1) / len(drive))
