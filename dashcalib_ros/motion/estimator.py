"""Images -> tracked points -> epipoles -> turning magnitude, at a constant cost per image."""
from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from dashcalib_ros.config import MaskConfig, MotionConfig
from dashcalib_ros.errors import InputError
from dashcalib_ros.frames.frame import Frame, GreyImage
from dashcalib_ros.motion.epipoles import Floats, epipoles_of, turning
from dashcalib_ros.motion.mask import EgoMask
from dashcalib_ros.motion.motion import Motion
from dashcalib_ros.motion.points import Mask, Points, find_corners
from dashcalib_ros.motion.segmentation import SegmentationMask, open_segmentation

# s between a triplet's images. Rotation adds up over it and vibration does not; further apart too
# few points survive a sharp turn. Correlation with kitti03's yaw rate: 0.95, 0.97, 0.98 for 0.1,
# 0.2, 0.3 s
SPACING = 0.3
# of the period; a camera that is this much early is on time, one of 13.3 Hz or less kept whole
EARLY = 0.25
# px, side of the Lucas-Kanade window, and levels of the pyramid
WINDOW = 9
LEVELS = 3
STEPS = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 12, 0.02)
BORDER = 5
REPLENISH = 0.65
# a standing car's points move over a whole triplet at most this many times standing_px, and hardly
# further than from one image to the next: night at 480 px has 1.5 px and a ratio of 0.4 to 1.2
JITTER = 6.0
NOWHERE = 1.5
# s; the ego vehicle is looked for at each spacing, and taken out of the tracking this often
MASK_PERIOD = 3.0


@dataclass(frozen=True)
class _Seen:
    """The points in one processed image: ids (n,) ascending, xy (n, 2) px."""

    index: int
    stamp_ns: int
    ids: npt.NDArray[np.int64]
    xy: Points


class MotionEstimator:
    """Tracks points through the drive and measures how much the car turns."""

    _seen: deque[_Seen]
    _pairs: dict[tuple[int, int], Floats | None]
    _last: GreyImage | None
    _ids: npt.NDArray[np.int64]
    _xy: Points
    _ego: EgoMask | None = None
    _segmented: SegmentationMask | None = None
    _valid: Mask | None = None

    def __init__(self, config: MotionConfig, mask: MaskConfig | None = None,
                 valid: Mask | None = None) -> None:
        """valid: (height, width) of the full image, False where the user masks; None: nowhere.

        Raises ConfigError for a segmentation model that cannot be used.
        """
        self.config = config
        self.mask_config = mask or MaskConfig()
        self._model = open_segmentation(self.mask_config)
        self._user = valid
        self._period_ns = 1e9 / config.rate
        self._shape: tuple[int, int] | None = None
        self._reset()

    def push(self, frame: Frame) -> Motion | None:
        """Take the next image; None when it is thinned away."""
        if frame.image.shape != self._shape:
            self._start(frame.image.shape)
        if self._seen:
            gap = frame.stamp_ns - self._seen[-1].stamp_ns
            if gap < 0:
                self._reset()
            elif gap < (1 - EARLY) * self._period_ns:
                return None
        image = self._shrink(frame.image)
        before = self._seen[-1] if self._seen else None
        self._follow(image)
        now = _Seen(frame.index, frame.stamp_ns, self._ids, self._xy)
        moved = math.nan if before is None else _median_shift(*_common(before, now))
        self._seen.append(now)
        first, middle = self._triplet()
        standing = moved < self.config.standing_px
        if first is not None:
            # in the dark points jitter by more than that, but they get nowhere
            whole = _median_shift(*_common(first, now))
            standing |= whole < min(JITTER * self.config.standing_px, NOWHERE * moved)
        magnitude = 0.0 if standing else self._magnitude(first, middle)
        if middle is not None and not standing:
            self._look_for_ego(image, middle, now)
            if self._segmented is not None and self._segmented.push(frame.image, frame.stamp_ns):
                self._exclude(self.valid())
        self._replenish(image)
        self._last = image
        return Motion(
            frame.index, frame.stamp_ns, magnitude, standing,
            moved * self._factor, len(now.ids), middle.index if middle else None,
            middle.stamp_ns if middle else None)

    def valid(self) -> Mask | None:
        """Return (height, width) of the full image: False where vehicle or user's mask hide it.

        The vehicle is what stays in the picture, and what the segmentation model takes for it.
        None while nothing is known to be hidden.
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

    def warnings(self) -> tuple[str, ...]:
        """Return what the user should know of the masks, one line each."""
        warning = self._segmented and self._segmented.warning()
        return (warning,) if warning else ()

    def _reset(self) -> None:
        """Forget the points: the next image does not continue the last."""
        keep = math.ceil(2 * SPACING * self.config.rate / (1 - EARLY)) + 3
        self._seen = deque(maxlen=keep)
        self._pairs = {}
        self._last = None
        self._ids = np.zeros(0, np.int64)
        self._xy = np.zeros((0, 2), np.float32)
        self._born = 0

    def _start(self, shape: tuple[int, ...]) -> None:
        """Begin with images of this shape."""
        if self._user is not None and self._user.shape != shape[:2]:
            raise InputError(
                f'the mask is {self._user.shape[1]}x{self._user.shape[0]}, the images are '
                f'{shape[1]}x{shape[0]}: give a mask of the images\' size')
        self._reset()
        self._shape = (shape[0], shape[1])
        self._factor = -(-shape[1] // self.config.width)
        self._ego = None
        # smaller pictures have no room for cells
        if self.mask_config.enabled and min(self._size) >= 4 * self.mask_config.cell:
            self._ego = EgoMask(self.mask_config, self._size)
        self._segmented = SegmentationMask(self._model) if self._model else None
        self._ego_ns = self._masked_ns = -math.inf
        self._exclude(self._user)

    def _exclude(self, valid: Mask | None) -> None:
        """Track only where the full image is valid."""
        self._valid = None
        if valid is not None:
            small = cv2.resize(valid.astype(np.uint8), self._size, interpolation=cv2.INTER_NEAREST)
            self._valid = small > 0

    def _look_for_ego(self, image: GreyImage, middle: _Seen, now: _Seen) -> None:
        epipoles = self._pairs.get((middle.index, now.index))
        early = abs(now.stamp_ns - self._ego_ns) < 0.9e9 * SPACING
        if self._ego is None or epipoles is None or early:
            return
        self._ego_ns = now.stamp_ns
        self._ego.push(image, *_common(middle, now), epipoles)
        if abs(now.stamp_ns - self._masked_ns) > 1e9 * MASK_PERIOD:
            self._masked_ns = now.stamp_ns
            self._exclude(self.valid())

    @property
    def _size(self) -> tuple[int, int]:
        assert self._shape is not None
        return max(1, self._shape[1] // self._factor), max(1, self._shape[0] // self._factor)

    def _shrink(self, image: GreyImage) -> GreyImage:
        if self._factor == 1:
            return image
        width, height = self._size
        whole = image[:height * self._factor, :width * self._factor]
        return np.asarray(cv2.resize(whole, self._size, interpolation=cv2.INTER_AREA), np.uint8)

    def _follow(self, image: GreyImage) -> None:
        """Move the points on to this image; drop those that do not track back."""
        if self._last is None or len(self._ids) == 0:
            return
        height, width = image.shape
        # the stubs do not know that cv2 makes room itself, nor which arrays come out
        flow: Any = cv2.calcOpticalFlowPyrLK
        window = (WINDOW, WINDOW)
        moved, ahead, _ = flow(
            self._last, image, self._xy, None, winSize=window, maxLevel=LEVELS, criteria=STEPS)
        # back at full resolution only, from where it should arrive: a third of the cost
        back, behind, _ = flow(
            image, self._last, moved, self._xy.copy(), winSize=window, maxLevel=0, criteria=STEPS,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW)
        error = np.linalg.norm(back - self._xy, axis=1)
        x, y = moved[:, 0], moved[:, 1]
        trusted = (
            (ahead.ravel() > 0) & (behind.ravel() > 0) & (error < self.config.forward_backward_px)
            & (x > BORDER) & (x < width - 1 - BORDER) & (y > BORDER) & (y < height - 1 - BORDER))
        if self._valid is not None:
            column = np.clip(np.rint(x), 0, width - 1).astype(int)
            row = np.clip(np.rint(y), 0, height - 1).astype(int)
            trusted &= self._valid[row, column]
        self._ids, self._xy = self._ids[trusted], moved[trusted]

    def _replenish(self, image: GreyImage) -> None:
        """Find new points where there are few; at half resolution, for tracking it is enough."""
        if len(self._ids) >= REPLENISH * self.config.points or min(image.shape) < 4 * BORDER:
            return
        half = np.asarray(
            cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)
        valid = None
        if self._valid is not None:
            valid = cv2.resize(self._valid.astype(np.uint8), half.shape[::-1],
                               interpolation=cv2.INTER_NEAREST) > 0
        corners = find_corners(half, self._xy / np.float32(2), self.config.points, valid) * 2 + 0.5
        self._ids = np.concatenate([self._ids, self._born + np.arange(len(corners))])
        self._xy = np.concatenate([self._xy, corners.astype(np.float32)])
        self._born += len(corners)

    def _triplet(self) -> tuple[_Seen | None, _Seen | None]:
        """Return the first and the middle image of the triplet that ends now, None until then."""
        middle = self._earlier(self._seen[-1])
        first = self._earlier(middle) if middle else None
        return (first, middle) if first else (None, None)

    def _magnitude(self, first: _Seen | None, middle: _Seen | None) -> float:
        """Return the triplet's turning magnitude; NaN without a triplet, or without epipoles."""
        if first is None or middle is None:
            return math.nan
        last = self._seen[-1]
        pairs = ((first, middle), (middle, last), (first, last))
        found = {(a.index, b.index): self._epipoles(a, b) for a, b in pairs}
        # the next triplets need only what begins within this one
        self._pairs = {key: value for key, value in {**self._pairs, **found}.items()
                       if key[0] >= first.index}
        values = [turning(epipoles) for epipoles in found.values() if epipoles is not None]
        return float(np.mean(values)) if values else math.nan

    def _earlier(self, seen: _Seen) -> _Seen | None:
        """Return the image nearest to one spacing before, None if there is none so early."""
        target = seen.stamp_ns - SPACING * 1e9
        before = [other for other in self._seen if other.stamp_ns < seen.stamp_ns]
        if not before or before[0].stamp_ns > target + 0.5 * self._period_ns:
            return None
        return min(before, key=lambda other: abs(other.stamp_ns - target))

    def _epipoles(self, a: _Seen, b: _Seen) -> Floats | None:
        """Return a pair's epipoles (2, 2); the same place twice while standing."""
        if (a.index, b.index) in self._pairs:
            return self._pairs[a.index, b.index]
        before, after = _common(a, b)
        if _median_shift(before, after) < self.config.standing_px:
            return np.zeros((2, 2))
        return epipoles_of(before, after, self._size, self.config.epipolar_px)


def _common(a: _Seen, b: _Seen) -> tuple[Points, Points]:
    """Return where the points seen in both images are, (n, 2) each."""
    _, in_a, in_b = np.intersect1d(a.ids, b.ids, assume_unique=True, return_indices=True)
    return a.xy[in_a], b.xy[in_b]


def _median_shift(before: Points, after: Points) -> float:
    """Return how far the median point moved in px; NaN without points."""
    if len(before) == 0:
        return math.nan
    return float(np.median(np.linalg.norm(after - before, axis=1)))
