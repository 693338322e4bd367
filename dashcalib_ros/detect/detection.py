# SPDX-License-Identifier: Apache-2.0
"""Frames -> turns: the first stage, as a stream."""
from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from dashcalib_ros.arrays import Floats, Mask
from dashcalib_ros.camera.camera import Camera, resized_pixels
from dashcalib_ros.config import Config
from dashcalib_ros.detect.detector import TurnDetector
from dashcalib_ros.detect.edges import LineCollector, Lines
from dashcalib_ros.detect.estimator import MotionEstimator, TrackedPoints
from dashcalib_ros.detect.one_camera import APART, OtherCamera, TwoPictures
from dashcalib_ros.detect.straights import PAIRS, Straights
from dashcalib_ros.detect.stretches import Keep, StretchBank
from dashcalib_ros.detect.turn import Turn
from dashcalib_ros.errors import InputError, Notice
from dashcalib_ros.input import Frame
from dashcalib_ros.input.decode import check_mask
from dashcalib_ros.input.scale import FULL_SIZE, Scale
from dashcalib_ros.input.source import size_text

# images after which the unit of the time stamps is checked; ns between images of a camera of
# 2 kHz: with microseconds, any camera above 2 Hz seems to be faster
FIRST_FRAMES = 10
SHORTEST_NS = 500_000
# other units that a program may use, and the longest time that the first images may take
UNITS_NS = {'microseconds': 10**3, 'milliseconds': 10**6, 'seconds': 10**9}
LONGEST_NS = 60 * 10**9


class Detection:
    """Finds the turns in the images of one camera, and keeps the best ones with their images.

    size: (width, height) of the images in px, None before the first one. scale: how images are
    resized before they are used. frames: number of images so far. standing: whether the car
    stands now.
    """

    def __init__(self, config: Config, mask: Mask | None = None, beside: bool = False,
                 keep: Keep | None = None) -> None:
        """mask: (h, w), False on the ego vehicle. beside: a thread of its own finds the lines.

        keep: as the StretchBank's.

        Raises ConfigError where the segmentation model cannot be used.
        """
        self._mask = mask
        if mask is not None:
            mask = Scale.of((mask.shape[1], mask.shape[0]), config).mask(mask)
        self.size: tuple[int, int] | None = None
        self.scale = FULL_SIZE
        self.frames = 0
        self._first_ns = self._last_ns = 0
        self._rises = 0
        self.standing = False
        self._config, self._keep = config, keep
        self._motion = MotionEstimator(config.tracking, config.mask, mask)
        self._two_pictures = TwoPictures()
        self._lines = LineCollector(beside=beside)
        # more turns than wanted replace those without a scene; --turns may be above the capacity
        self._turns = TurnDetector(replace(
            config.turns, capacity=max(config.turns.capacity, config.turns.wanted)))
        self._stretches = StretchBank(config.turns.stretches, 2 * config.turns.half_width,
                                      self.turns, keep)

    @property
    def start_s(self) -> float:
        """Return the stamp of the first image, s."""
        return self._first_ns / 1e9

    @property
    def seconds(self) -> float:
        """Return the duration of the drive so far, from the first image to the last, s."""
        return (self._last_ns - self._first_ns) / 1e9

    @property
    def magnitude(self) -> float:
        """Return the newest filtered turning magnitude, of the image width."""
        return self._turns.magnitude

    def push(self, frame: Frame) -> list[Turn]:
        """Take the next frame; return the turns that are new. They do not change any more.

        Raises InputError where its size differs from the first one's or from the mask's, where it
        is not a grey image of bytes, where the stamps cannot be nanoseconds, and where all images
        show two pictures.
        """
        _check_image(frame)
        self._check_size(frame)
        self._check_stamps(frame)
        self.frames += 1
        frame = self.scale.frame(frame)
        motion = self._motion.push(frame)
        if motion is None:
            return []
        self.standing = motion.standing
        if not motion.standing:
            try:
                self._two_pictures.push(frame.image, frame.stamp_ns)
            except InputError:
                # what seemed to be a turn was none
                self._turns = TurnDetector(self._turns.config)
                raise
            self._lines.push(frame.image, frame.stamp_ns)
        new = self._turns.push(frame, motion)
        self._stretches.push(frame, motion.shift, motion.after_gap)
        return new

    def finish(self) -> list[Turn]:
        """End the drive; return the turns that are new."""
        new = self._turns.finish()
        self._stretches.finish()
        return new

    def close(self) -> None:
        """End the thread that finds lines, and free all images; lines and turns are kept.

        Python frees what refers to itself, as a calibrator does, only now and then.
        """
        self._lines.close()
        self._turns.close()
        self._stretches.free_images()

    def turns(self) -> tuple[Turn, ...]:
        """Return the best turns so far, the most prominent first."""
        return self._turns.bank.turns()

    def stretches(self) -> tuple[Turn, ...]:
        """Return other stretches of the drive, those first that promise most."""
        return self._stretches.stretches()

    def want_stretches(self, wanted: bool) -> None:
        """Collect such stretches from now on, or none."""
        self._stretches.want(wanted)

    def release(self, center: int) -> None:
        """Free the images of the turn with this center; the turn itself is kept."""
        self._exchange(center, ())

    def set_aside(self, turn: Turn) -> None:
        """Keep the images of a turn where those of other stretches are."""
        assert self._keep is not None
        images = self._keep([frame.image for frame in turn.frames])
        self._exchange(turn.center, tuple(replace(frame, image=image) for frame, image
                                          in zip(turn.frames, images, strict=True)))

    def resized(self, camera: Camera) -> Camera:
        """Return a camera of the input's pictures as one of the resized pictures.

        Raises InputError where it is for pictures of another size.
        """
        if camera.image_size != self.size:
            raise InputError('E-CALIBRATION-SIZE',
                             f'the given camera is for pictures of another size: '
                             f'{size_text(camera.image_size)}; resize it with dashcalib export '
                             f'--size')
        return camera.resized(1 / self.scale.px, self.scale.size(self.size))

    def _exchange(self, center: int, frames: tuple[Frame, ...]) -> None:
        self._turns.bank.exchange(center, frames)
        self._stretches.exchange(center, frames)

    def magnitudes(self) -> Floats:
        """Return (n, 2): stamp in s and filtered turning magnitude, decimated."""
        return self._turns.magnitudes()

    def valid(self) -> Mask | None:
        """Return (h, w) of the resized images, False on the ego vehicle; None: no mask."""
        return self._motion.valid()

    def points(self) -> TrackedPoints:
        """Return the points tracked in the newest image, in px of the input."""
        points, px = self._motion.points(), np.float32(self.scale.px)
        return TrackedPoints(*(resized_pixels(xy, px) for xy in (points.before, points.now)))

    def lines(self) -> Lines:
        """Return the upright lines of the drive so far, in the resized images."""
        return self._lines.lines().within(self.valid())

    @property
    def straight_pairs(self) -> int:
        """Return how many pairs of images of straight driving there are."""
        return self._motion.straight_pairs

    def straights(self, newest: int = PAIRS) -> Straights:
        """Return pairs of images of straight driving, the newest, in px of the resized images."""
        return self._motion.straights(newest)

    def warnings(self) -> tuple[Notice, ...]:
        """Return warnings for the user, one line each."""
        found = self.other_camera
        return (*((Notice('E-TWO-CAMERAS', f'{found}: {APART}'),) if found else ()),
                *self._motion.warnings())

    @property
    def other_camera(self) -> OtherCamera | None:
        """Return the other camera that skipped images show; None where there is none."""
        return self._motion.one_camera.other

    @property
    def mixed(self) -> bool:
        """Return whether the newest images are of two cameras."""
        return self._motion.one_camera.mixed

    def _check_size(self, frame: Frame) -> None:
        if self.size is None:
            check_mask(self._mask, frame.size)
            self.scale = Scale.of(frame.size, self._config)
            self.size = frame.size
        elif frame.size != self.size:
            raise InputError(
                'E-IMAGE-SIZE-CHANGES', f'the image size changes from {self.size[0]}x'
                f'{self.size[1]} to {frame.size[0]}x{frame.size[1]} at frame {frame.index}: '
                f'calibrate each size separately')

    def _check_stamps(self, frame: Frame) -> None:
        """Check once that time passes between the first images, in the right unit."""
        if self.frames == 0:
            self._first_ns = self._last_ns = frame.stamp_ns
        before, self._last_ns = self._last_ns, frame.stamp_ns
        if self.frames > FIRST_FRAMES:
            return
        # a clock may be set back once, but then it goes on
        self._rises += frame.stamp_ns > before
        passed = frame.stamp_ns - self._first_ns
        too_short = 0 <= passed < FIRST_FRAMES * SHORTEST_NS
        if self.frames == FIRST_FRAMES and (too_short or self._rises < FIRST_FRAMES // 2):
            unit = next((name for name, ns in UNITS_NS.items()
                         if FIRST_FRAMES * SHORTEST_NS <= passed * ns < LONGEST_NS), '')
            what = (f'the unit seems to be {unit}' if unit
                    else 'they do not increase, or they count images')
            raise InputError(
                'E-STAMP-UNIT', f'the first {FIRST_FRAMES} images cover {passed} ns: time stamps '
                f'(Frame.stamp_ns) must increase and be in nanoseconds; {what}; correct the '
                f'program that writes them')


def detect(frames: Iterable[Frame], config: Config, mask: Mask | None = None,
           keep: Keep | None = None) -> Detection:
    """Find the turns of a drive. For a stream, call Detection.push() for each frame.

    mask: (h, w), False on the ego vehicle. keep: how the images of other stretches are kept; None:
    there are none. Raises InputError as Detection.push() does.
    """
    detection = Detection(config, mask, keep=keep)
    detection.want_stretches(keep is not None)
    for frame in frames:
        detection.push(frame)
    detection.finish()
    return detection


def _check_image(frame: Frame) -> None:
    if frame.image.ndim != 2 or frame.image.dtype != np.uint8:
        shape = 'x'.join(map(str, frame.image.shape))
        raise InputError(
            'E-FRAME-NOT-GREY', f'Frame.image must be grey, (height, width) of uint8, and frame '
            f'{frame.index} is {shape} of {frame.image.dtype}: convert a colour image with '
            f'cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)')
