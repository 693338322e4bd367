# SPDX-License-Identifier: Apache-2.0
"""Corner points: found in an image, and tracked from image to image."""
from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from dashcalib_ros.arrays import Floats32, GreyImage, Ints, Mask

# px; a point that does not track back to within this is dropped
FORWARD_BACKWARD_PX = 0.5
# points of a cell of the grid over which corners are spread
CELL_POINTS = 25
# from a new corner to the points that there are, of the mean distance between those wanted
SPACING = 0.4
# of the strongest corner in its cell; a weaker one is not used
QUALITY = 0.02
# px, height and width; OpenCV's dense flow crashes in pictures that are narrower
DENSE_FLOW_PX = 32


@dataclass(frozen=True)
class Tracking:
    """Options of the tracking; the defaults are those of a reconstruction.

    window: px, (width, height) of the Lucas-Kanade window. OpenCV takes eight columns at once, and
    what is left one by one. levels: of the pyramid, above the full picture; None: no pyramid, the
    search begins where dense optical flow leads, which takes half to two thirds of the time.
    steps, step_px: the iteration ends after this many steps, or with a step this short.
    border: px; points nearer to it are dropped: where the window leaves the picture, they drift.
    """

    window: tuple[int, int] = (24, 21)
    levels: int | None = None
    steps: int = 10
    step_px: float = 0.03
    border: int = 8


def find_corners(image: GreyImage, present: Floats32, wanted: int,
                 valid: Mask | None = None) -> Floats32:
    """Return (n, 2) new corners, spread over a grid, so that there are about `wanted` points.

    They are right to a pixel, which is enough to follow them. present: (m, 2) points that are
    tracked already; no new corner is near them. valid: (height, width), False where no corner may
    be; None: nowhere.
    """
    # in pairs of pixels, as all that follows
    height, width = (side // 2 for side in image.shape)
    if min(height, width) == 0:
        return np.zeros((0, 2), np.float32)
    taken = np.zeros((height, width), np.uint8)
    there = np.clip(present / 2, 0, (width - 1, height - 1)).astype(int)
    taken[there[:, 1], there[:, 0]] = 1
    strength = corner_strength(image)
    spacing = max(2, round(SPACING * math.sqrt(height * width / wanted)))
    corner = (strength > 0) & (strength >= cv2.dilate(strength, _square(spacing // 2)))
    corner &= cv2.dilate(taken, _square(spacing - 1)) == 0
    if valid is not None:
        corner &= valid[1:2 * height:2, 1:2 * width:2]

    y, x = np.nonzero(corner)
    lacking = _lacking(there, (width, height), wanted)
    cell, strong = _cells(np.column_stack([x, y]), (width, height), lacking.shape), strength[y, x]
    # the strongest of each cell first
    order = np.lexsort((-strong, cell))
    cell, strong = cell[order], strong[order]
    first = np.searchsorted(cell, cell)
    found = order[(np.arange(len(cell)) - first < lacking.ravel()[cell])
                  & (strong > QUALITY * strong[first])]
    return (2 * np.column_stack([x[found], y[found]]) + 0.5).astype(np.float32)


def find_clear_corners(image: GreyImage, present: Floats32, wanted: int,
                       valid: Mask | None = None) -> Floats32:
    """Return what find_corners() does, for a few points in a small picture.

    OpenCV's choice takes three times as long, but half as many lie on burnt-in text and on the
    edge of a bonnet, where the world's motion is not seen.
    """
    height, width = image.shape
    lacking = _lacking(present, (width, height), wanted)
    rows, columns = lacking.shape
    spacing = max(4, width // 100)
    free = np.full(image.shape, 255, np.uint8)
    if valid is not None:
        free[~valid] = 0
    for place in present.astype(int).tolist():
        cv2.circle(free, place, spacing, 0, -1)
    found = [np.zeros((0, 2), np.float32)]
    for row, column in np.argwhere(lacking > 0):
        top, bottom = row * height // rows, (row + 1) * height // rows
        left, right = column * width // columns, (column + 1) * width // columns
        window = np.s_[top:bottom, left:right]
        corners = cv2.goodFeaturesToTrack(
            image[window], int(lacking[row, column]), QUALITY, spacing, mask=free[window],
            blockSize=5)
        if corners is not None:
            found.append(np.asarray(corners.reshape(-1, 2) + (left, top), np.float32))
    return np.concatenate(found)


def _lacking(present: npt.NDArray[Any], size: tuple[int, int], wanted: int) -> Ints:
    """Return (rows, columns) of a grid over the picture: how many points each cell lacks.

    present: (m, 2) points. size: (width, height). Negative where a cell has more than its share.
    """
    width, height = size
    rows, columns = (max(2, round(math.sqrt(wanted / CELL_POINTS * side / other)))
                     for side, other in ((height, width), (width, height)))
    held = np.bincount(_cells(present, size, (rows, columns)), minlength=rows * columns)
    return np.asarray(-(-wanted // (rows * columns)) - held.reshape(rows, columns), np.int64)


def _cells(places: npt.NDArray[Any], size: tuple[int, int], shape: tuple[int, ...]) -> Ints:
    """Return (n,) the cell of each place (n, 2), counted row by row; shape: (rows, columns)."""
    grid = shape[::-1]
    column, row = np.clip(places * grid / size, 0, np.subtract(grid, 1)).astype(np.int64).T
    return np.asarray(row * grid[0] + column)


def corner_strength(image: GreyImage) -> Floats32:
    """Return (height / 2, width / 2) twice the smaller eigenvalue of the gradients' covariance.

    The gradients are those of the full picture, which keeps its details; their products are
    summed over 6 x 6 pixels (Shi and Tomasi). OpenCV's own takes four times as long.
    """
    height, width = (side // 2 for side in image.shape)
    even = image[:2 * height, :2 * width]
    x, y = cv2.Sobel(even, cv2.CV_32F, 1, 0), cv2.Sobel(even, cv2.CV_32F, 0, 1)
    xx, xy, yy = (cv2.blur(cv2.resize(cv2.multiply(a, b), (width, height),
                                      interpolation=cv2.INTER_AREA), (3, 3))
                  for a, b in ((x, x), (x, y), (y, y)))
    # the last digit of cv2.magnitude depends on where an array lies in memory
    apart, mixed = xx - yy, xy + xy
    return np.asarray(xx + yy - np.sqrt(apart * apart + mixed * mixed), np.float32)


def _square(reach: int) -> GreyImage:
    return np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)


def follow_points(before: GreyImage, after: GreyImage, points: Floats32, tracking: Tracking
                  ) -> tuple[Floats32, Mask]:
    """Track points from one image to the next by pyramidal Lucas-Kanade, and back as a check.

    Returns the (n, 2) positions in `after` and (n,) whether each can be trusted.
    """
    if len(points) == 0:
        return points, np.zeros(0, bool)
    height, width = after.shape
    # cv2's stubs have wrong types for this function
    flow: Any = cv2.calcOpticalFlowPyrLK
    ends = cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, tracking.steps, tracking.step_px
    settings = {'winSize': tracking.window, 'criteria': ends,
                'flags': cv2.OPTFLOW_USE_INITIAL_FLOW}
    begun = points.copy() if tracking.levels is not None else _led(before, after, points)
    moved, ahead, _ = flow(before, after, points, begun, maxLevel=tracking.levels or 0, **settings)
    x, y, border = moved[:, 0], moved[:, 1], tracking.border
    trusted = np.asarray(
        (ahead.ravel() > 0)
        & (x > border) & (x < width - 1 - border) & (y > border) & (y < height - 1 - border))
    if trusted.any():
        # the backward search starts from the point itself: a wrong match still ends elsewhere, and
        # the full picture is enough
        start = points[trusted]
        back, behind, _ = flow(after, before, moved[trusted], start.copy(), maxLevel=0, **settings)
        trusted[trusted] = ((behind.ravel() > 0)
                            & (np.linalg.norm(back - start, axis=1) < FORWARD_BACKWARD_PX))
    return moved, trusted


def _led(before: GreyImage, after: GreyImage, points: Floats32) -> Floats32:
    """Return (n, 2) where dense optical flow leads the points, right to a few pixels."""
    # even sizes are halved exactly, and OpenCV then takes a fortieth of the time
    height, width = (max(side - side % 2, 1) for side in after.shape)
    share = max(0.5, DENSE_FLOW_PX / min(height, width))
    size = math.ceil(width * share), math.ceil(height * share)
    halves = [cv2.resize(image[:height, :width], size, interpolation=cv2.INTER_AREA)
              for image in (before, after)]
    dense = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    # cv2's stubs ask for the array that it returns
    flow = dense.calc(halves[0], halves[1], None)  # type: ignore[call-overload]
    scale = np.array([width / size[0], height / size[1]], np.float32)
    x, y = ((points + np.float32(0.5)) / scale - np.float32(0.5)).T
    step = cv2.remap(flow, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(points + scale * step.reshape(-1, 2), np.float32)
