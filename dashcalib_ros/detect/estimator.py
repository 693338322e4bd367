# SPDX-License-Identifier: Apache-2.0
"""Images -> tracked points -> epipoles -> turning magnitude, at a constant cost per image."""
from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import cv2
import numpy as np

from dashcalib_ros.arrays import Floats, Floats32, GreyImage, Ints, Mask
from dashcalib_ros.camera.camera import resized_pixels
from dashcalib_ros.config import MaskConfig, TrackingConfig
from dashcalib_ros.detect.continuity import goes_on
from dashcalib_ros.detect.epipoles import epipoles_of, turning
from dashcalib_ros.detect.mask import CELL, EgoMask
from dashcalib_ros.detect.one_camera import USUAL_STEP, OneCamera
from dashcalib_ros.detect.points import Tracking, find_clear_corners, follow_points
from dashcalib_ros.detect.segmentation import SegmentationMask, open_segmentation
from dashcalib_ros.detect.straights import PAIRS, STRAIGHT, StraightCollector, Straights
from dashcalib_ros.errors import Notice
from dashcalib_ros.input import Frame
from dashcalib_ros.input.decode import check_mask
from dashcalib_ros.input.scale import shrink_image
from dashcalib_ros.input.stamps import EARLY, Looks, least_step_ns

# s between the images of a triplet: rotation adds up over it and vibration does not; farther apart
# few points stay visible in a sharp turn
SPACING_S = 0.3
# px; smaller pictures have no room for points
LEAST_SIDE = 20
# times standing_px; a standing car's points move at most so far over a triplet, at night
JITTER = 6.0
# times the step from image to image; jitter does not add up over a triplet, motion does
JITTER_GROWTH = 1.5
# px at the working width; inlier threshold of the fundamental matrix
EPIPOLAR_PX = 0.5
# of points; where fewer are left, new ones are looked for
REPLENISH = 0.65
# s between two updates of the mask that the tracking uses
MASK_PERIOD_S = 3.0


@dataclass(frozen=True)
class Motion:
    """Motion at one image, measured over the triplet of images that ends with it.

    index, stamp_ns: of the image. center, center_ns: index and stamp of the triplet's middle
    image, which the magnitude belongs to; None before there is a triplet. magnitude: turning
    magnitude, as a share of the image width (see epipoles.py); 0 where the car stands, NaN where
    no epipole is found. standing: the car stands. moved_px: motion of the median point since the
    last processed image, in px at full resolution. points: number of tracked points. after_gap:
    the tracking started again, and this image does not follow the last one. shift: (x, y) of the
    median point since the last processed image, as a share of the image width; NaN without points.
    """

    index: int
    stamp_ns: int
    magnitude: float
    standing: bool
    moved_px: float
    points: int = 0
    center: int | None = None
    center_ns: int | None = None
    after_gap: bool = False
    shift: tuple[float, float] = (math.nan, math.nan)


@dataclass(frozen=True)
class TrackedPoints:
    """The points in the newest image, (n, 2) px of the full image: now, and one spacing before.

    before is equal to now for points that are new.
    """

    before: Floats32
    now: Floats32


@dataclass(frozen=True)
class _Seen:
    """The points in one processed image: ids (n,) ascending, xy (n, 2) px.

    followed: the share of the last image's points that were found; NaN where there were none.
    """

    index: int
    stamp_ns: int
    ids: Ints
    xy: Floats32
    followed: float


@dataclass(frozen=True)
class _Triplet:
    first: _Seen
    middle: _Seen
    last: _Seen


class MotionEstimator:
    """Tracks points through the drive and measures how much the car turns.

    one_camera: whether the skipped images are of the same camera as the others.
    """

    _last: GreyImage | None = None
    _ego: EgoMask | None = None
    _segmented: SegmentationMask | None = None
    _valid: Mask | None = None
    _factor: int = 1
    _perhaps_gap: bool = False
    # the newest image that is left out and looked at
    _between: GreyImage | None = None

    def __init__(self, config: TrackingConfig, mask: MaskConfig | None = None,
                 valid: Mask | None = None) -> None:
        """valid: (height, width) of the full image, False where the user masks; None: nowhere.

        Raises ConfigError for a segmentation model that cannot be used.
        """
        self.config = config
        self.mask_config = mask or MaskConfig()
        self._model = open_segmentation(self.mask_config)
        self._user = valid
        self._period_ns = 1e9 / config.rate
        # a small window, as this runs on every image; one pixel of the coarsest level is 8 px of
        # the picture, enough for the motion in a sharp turn
        self._tracking = Tracking(window=(9, 9), levels=3, steps=12, step_px=0.02, border=5)
        self._shape: tuple[int, int] | None = None
        self._straights = StraightCollector()
        self._looks = Looks()
        self.one_camera = OneCamera()
        self._reset()

    def push(self, frame: Frame) -> Motion | None:
        """Take the next image; None if it is skipped, as the camera is faster than config.rate."""
        if frame.image.shape != self._shape:
            self._start(frame.image.shape)
        # a skipped image leaves the question to the next one
        self._perhaps_gap |= frame.perhaps_after_gap
        after_gap = self._resets(frame)
        if self._skips(frame):
            return None
        image = shrink_image(frame.image, self._factor)
        now, lost = self._track(frame, image)
        step = _common(self._seen[-1] if self._seen else None, now)
        moved_px = _median_shift(*step)
        self._compare_between(*step)
        self._seen.append(now)
        triplet = self._triplet()
        standing = self._is_standing(moved_px, triplet)
        magnitude = 0.0 if standing else self._magnitude(triplet)
        if triplet is not None and not standing:
            self._collect_straight(triplet, magnitude)
            self._look_for_vehicle(frame, image, triplet)
        self._replenish(image)
        self._last = image
        middle = triplet.middle if triplet else None
        return Motion(
            frame.index, frame.stamp_ns, magnitude, standing, moved_px * self._factor,
            len(now.ids), middle.index if middle else None, middle.stamp_ns if middle else None,
            after_gap or lost, _shift(*step, image.shape[1]))

    def valid(self) -> Mask | None:
        """Return (height, width) of the full image, False where it is masked; None: no mask.

        Masked is what the user masks, and the ego vehicle as the automatic mask and the
        segmentation model find it.
        """
        valid = self._user
        if self._shape is None:
            return valid
        found = [self._ego.hidden(self._shape, self._factor) if self._ego else None,
                 self._segmented.hidden(self._shape) if self._segmented else None]
        for hidden in found:
            if hidden is not None:
                valid = ~hidden if valid is None else valid & ~hidden
        return valid

    def points(self) -> TrackedPoints:
        """Return the points in the newest image, and where they were one spacing before."""
        now = self._xy.copy()
        before = now.copy()
        earlier = self._earlier(self._seen[-1]) if self._seen else None
        if earlier is not None:
            _, here, there = np.intersect1d(self._ids, earlier.ids, assume_unique=True,
                                            return_indices=True)
            before[here] = earlier.xy[there]
        factor = np.float32(self._factor)
        return TrackedPoints(*(resized_pixels(xy, factor) for xy in (before, now)))

    @property
    def straight_pairs(self) -> int:
        """Return the number of pairs of images of straight driving."""
        return len(self._straights)

    def straights(self, newest: int = PAIRS) -> Straights:
        """Return pairs of images of straight driving, the newest, in px of the full image."""
        found, factor = self._straights.straights(newest), np.float32(self._factor)
        return replace(found, before=resized_pixels(found.before, factor),
                       after=resized_pixels(found.after, factor))

    def warnings(self) -> tuple[Notice, ...]:
        """Return warnings about the images and the masks for the user, one line each."""
        warning, jump = self._segmented and self._segmented.warning(), self.one_camera.jump
        return (*((warning,) if warning else ()), *(() if jump is None else (Notice(
            'E-VIEW-JUMPS', f'image {jump} shows another view than the one before, with no gap in '
            f'time: check that all images are of one camera and that none is missing'),)))

    def _reset(self) -> None:
        keep = math.ceil(2 * SPACING_S * self.config.rate / (1 - EARLY)) + 3
        self._seen: deque[_Seen] = deque(maxlen=keep)
        self._pairs: dict[tuple[int, int], Floats | None] = {}
        self._turning = -math.inf, math.nan
        self._last = None
        self._ids: Ints = np.zeros(0, np.int64)
        self._xy: Floats32 = np.zeros((0, 2), np.float32)
        self._born = 0
        self._perhaps_gap = False

    def _start(self, shape: tuple[int, ...]) -> None:
        check_mask(self._user, (shape[1], shape[0]))
        self._reset()
        self._shape = (shape[0], shape[1])
        self._factor = -(-shape[1] // self.config.width)
        self._ego = None
        # smaller pictures are too small for the mask's cells
        if self.mask_config.enabled and min(self._size) >= 4 * CELL:
            self._ego = EgoMask(self._size)
        self._segmented = SegmentationMask(self._model, self.mask_config) if self._model else None
        self._ego_ns = self._masked_ns = -math.inf
        self._exclude(self._user)

    def _exclude(self, valid: Mask | None) -> None:
        self._valid = None
        if valid is not None:
            small = cv2.resize(valid.astype(np.uint8), self._size, interpolation=cv2.INTER_NEAREST)
            self._valid = small > 0

    def _resets(self, frame: Frame) -> bool:
        """Drop all points where the clock was set back, or a gap is known; return whether so."""
        if not self._seen:
            return False
        after_gap = frame.after_gap or frame.stamp_ns < self._seen[-1].stamp_ns
        if after_gap:
            self._reset()
        return after_gap

    def _skips(self, frame: Frame) -> bool:
        """Return whether the image comes too early; some of those are compared later."""
        if not self._seen or (frame.stamp_ns - self._seen[-1].stamp_ns
                              >= least_step_ns(self.config.rate)):
            return False
        if self._looks.due(frame.stamp_ns):
            self._between = shrink_image(frame.image, self._factor)
        return True

    def _track(self, frame: Frame, image: GreyImage) -> tuple[_Seen, bool]:
        """Return the points in this image, and whether it does not follow the last one."""
        before = self._xy
        followed = self._follow(image)
        if self._last is not None:
            self.one_camera.look_at_next(
                (self._last, image), before, followed, frame.index, self._tracking,
                self._perhaps_gap or self._is_late(frame))
        lost = self._perhaps_gap and bool(self._seen) and not self._goes_on(followed)
        if lost:
            followed = math.nan
            self._reset()
        self._perhaps_gap = False
        return _Seen(frame.index, frame.stamp_ns, self._ids, self._xy, followed), lost

    def _is_late(self, frame: Frame) -> bool:
        stamps = [seen.stamp_ns for seen in self._seen]
        return (len(stamps) < 2 or frame.stamp_ns - stamps[-1]
                > USUAL_STEP * float(np.median(np.diff(stamps))))

    def _compare_between(self, before: Floats32, now: Floats32) -> None:
        if self._last is not None and self._between is not None:
            self.one_camera.look((self._last, self._between), before, now, self._tracking)
        self._between = None

    def _is_standing(self, moved_px: float, triplet: _Triplet | None) -> bool:
        """Return whether the car stands; moved_px: the median point since the last image."""
        if moved_px < self.config.standing_px:
            return True
        if triplet is None:
            return False
        # in the dark, points of a standing car jitter by more, but do not move away
        over_triplet = _median_shift(*_common(triplet.first, triplet.last))
        return over_triplet < min(JITTER * self.config.standing_px, JITTER_GROWTH * moved_px)

    def _collect_straight(self, triplet: _Triplet, magnitude: float) -> None:
        """Keep the triplet's ends, now and then, where the car drives straight on."""
        first, last = triplet.first, triplet.last
        if 0 < magnitude < STRAIGHT and self._straights.wants(last.stamp_ns):
            self._straights.push(first.stamp_ns, last.stamp_ns, *_common(first, last))

    def _look_for_vehicle(self, frame: Frame, image: GreyImage, triplet: _Triplet) -> None:
        """Let the automatic mask and the segmentation model see an image of the moving car."""
        self._look_for_ego(image, triplet.middle, triplet.last)
        if self._segmented is not None and self._segmented.push(frame.image, frame.stamp_ns):
            self._exclude(self.valid())

    def _look_for_ego(self, image: GreyImage, middle: _Seen, now: _Seen) -> None:
        epipoles = self._pairs.get((middle.index, now.index))
        early = abs(now.stamp_ns - self._ego_ns) < 0.9e9 * SPACING_S
        if self._ego is None or epipoles is None or early:
            return
        self._ego_ns = now.stamp_ns
        self._ego.push(image, *_common(middle, now), epipoles)
        if abs(now.stamp_ns - self._masked_ns) > 1e9 * MASK_PERIOD_S:
            self._masked_ns = now.stamp_ns
            self._exclude(self.valid())

    @property
    def _size(self) -> tuple[int, int]:
        assert self._shape is not None
        return max(1, self._shape[1] // self._factor), max(1, self._shape[0] // self._factor)

    def _follow(self, image: GreyImage) -> float:
        """Move the points on to this image; drop those that do not track back.

        Returns the share of them that is left, NaN if there were none.
        """
        if self._last is None or len(self._ids) == 0:
            return math.nan
        moved, trusted = follow_points(self._last, image, self._xy, self._tracking)
        if self._valid is not None:
            height, width = image.shape
            column = np.clip(np.rint(moved[:, 0]), 0, width - 1).astype(int)
            row = np.clip(np.rint(moved[:, 1]), 0, height - 1).astype(int)
            trusted &= self._valid[row, column]
        self._ids, self._xy = self._ids[trusted], moved[trusted]
        return float(np.mean(trusted))

    def _goes_on(self, followed: float) -> bool:
        """Return whether the image with the points of now follows the last one without a gap.

        followed: the share of the last image's points that were found.
        """
        usual = [seen.followed for seen in self._seen if not math.isnan(seen.followed)]
        if not usual:
            return False
        before, last = self._seen[-2], self._seen[-1]
        ids = np.intersect1d(before.ids, self._ids, assume_unique=True)
        first, middle, now = (xy[np.searchsorted(own, ids)] for own, xy in (
            (before.ids, before.xy), (last.ids, last.xy), (self._ids, self._xy)))
        return goes_on(first, middle, now, followed, min(usual))

    def _replenish(self, image: GreyImage) -> None:
        """Add points where there are few; they are found at half resolution, which is enough."""
        enough = len(self._ids) >= REPLENISH * self.config.points
        if enough or min(image.shape) < LEAST_SIDE:
            return
        half, valid = shrink_image(image, 2), None
        if self._valid is not None:
            valid = cv2.resize(self._valid.astype(np.uint8), half.shape[::-1],
                               interpolation=cv2.INTER_NEAREST) > 0
        corners = 2 * find_clear_corners(half, self._xy / np.float32(2), self.config.points,
                                         valid) + 0.5
        self._ids = np.concatenate([self._ids, self._born + np.arange(len(corners))])
        self._xy = np.concatenate([self._xy, corners.astype(np.float32)])
        self._born += len(corners)

    def _triplet(self) -> _Triplet | None:
        last = self._seen[-1]
        middle = self._earlier(last)
        first = self._earlier(middle) if middle else None
        return _Triplet(first, middle, last) if first and middle else None

    def _magnitude(self, triplet: _Triplet | None) -> float:
        """Return the triplet's turning magnitude; NaN without a triplet, or without epipoles.

        With three images a spacing or more, it is measured once a spacing; between, the last one
        is returned.
        """
        if triplet is None:
            return math.nan
        first, middle, last = triplet.first, triplet.middle, triplet.last
        # triplets at each image cost three times as much and add nothing; a slow camera has few,
        # and each counts
        spacing_ns = 1e9 * SPACING_S
        fast = last.stamp_ns - self._seen[-2].stamp_ns < 0.4 * spacing_ns
        if fast and last.stamp_ns - self._turning[0] < spacing_ns - 0.5 * self._period_ns:
            return self._turning[1]
        pairs = ((first, middle), (middle, last), (first, last))
        found = {(a.index, b.index): self._epipoles(a, b) for a, b in pairs}
        # the next triplets need only pairs that begin within this one
        self._pairs = {key: value for key, value in {**self._pairs, **found}.items()
                       if key[0] >= first.index}
        values = [turning(epipoles) for epipoles in found.values() if epipoles is not None]
        self._turning = last.stamp_ns, float(np.mean(values)) if values else math.nan
        return self._turning[1]

    def _earlier(self, seen: _Seen) -> _Seen | None:
        """Return the image that is nearest to one spacing earlier, None if there is none."""
        target = seen.stamp_ns - SPACING_S * 1e9
        before = [other for other in self._seen if other.stamp_ns < seen.stamp_ns]
        if not before or before[0].stamp_ns > target + 0.5 * self._period_ns:
            return None
        return min(before, key=lambda other: abs(other.stamp_ns - target))

    def _epipoles(self, a: _Seen, b: _Seen) -> Floats | None:
        """Return a pair's epipoles (2, 2); both at the centre if nothing moved."""
        if (a.index, b.index) in self._pairs:
            return self._pairs[a.index, b.index]
        before, after = _common(a, b)
        if _median_shift(before, after) < self.config.standing_px:
            return np.zeros((2, 2))
        return epipoles_of(before, after, self._size, EPIPOLAR_PX)


def _common(a: _Seen | None, b: _Seen) -> tuple[Floats32, Floats32]:
    """Return the positions of the points seen in both images, (n, 2) in each."""
    if a is None:
        return b.xy[:0], b.xy[:0]
    _, in_a, in_b = np.intersect1d(a.ids, b.ids, assume_unique=True, return_indices=True)
    return a.xy[in_a], b.xy[in_b]


def _shift(before: Floats32, after: Floats32, width: int) -> tuple[float, float]:
    """Return how far the median point moved in x and y, of the width; NaN without points."""
    if len(before) == 0:
        return math.nan, math.nan
    x, y = np.median(after - before, axis=0) / width
    return float(x), float(y)


def _median_shift(before: Floats32, after: Floats32) -> float:
    """Return how far the median point moved in px; NaN without points."""
    if len(before) == 0:
        return math.nan
    return float(np.median(np.linalg.norm(after - before, axis=1)))
