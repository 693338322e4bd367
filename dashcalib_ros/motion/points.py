"""Points: found where the picture has corners, followed from image to image."""
from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

Points = npt.NDArray[np.float32]
Grey = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]
# px; where the tracking window leaves the picture, positions drift
BORDER = 8


def find_corners(image: npt.NDArray[np.uint8], present: npt.NDArray[np.float32], wanted: int,
                 valid: Mask | None = None) -> npt.NDArray[np.float32]:
    """Return (n, 2) new corners that bring the picture up to `wanted`, spread over a grid.

    present: (m, 2) points that are tracked already; no corner is put near them.
    """
    height, width = image.shape
    columns = max(2, round(np.sqrt(wanted / 25 * width / height)))
    rows = max(2, round(np.sqrt(wanted / 25 * height / width)))
    spacing = max(4, width // 100)
    free = np.full(image.shape, 255, np.uint8)
    if valid is not None:
        free[~valid] = 0
    for x, y in present:
        cv2.circle(free, (int(x), int(y)), spacing, 0, -1)
    share = -(-wanted // (columns * rows))
    cell = (np.clip(present[:, 1] * rows / height, 0, rows - 1).astype(int) * columns
            + np.clip(present[:, 0] * columns / width, 0, columns - 1).astype(int))
    held = np.bincount(cell, minlength=rows * columns).reshape(rows, columns)
    found = [np.zeros((0, 2), np.float32)]
    for row, column in np.argwhere(held < share):
        top, bottom = row * height // rows, (row + 1) * height // rows
        left, right = column * width // columns, (column + 1) * width // columns
        window = np.s_[top:bottom, left:right]
        corners = cv2.goodFeaturesToTrack(
            image[window], int(share - held[row, column]), 0.02, spacing, mask=free[window],
            blockSize=5)
        if corners is not None:
            found.append(np.asarray(corners.reshape(-1, 2) + (left, top), np.float32))
    return np.concatenate(found)


def follow_points(before: npt.NDArray[np.uint8], after: npt.NDArray[np.uint8],
                  points: npt.NDArray[np.float32], forward_backward_px: float, window: int = 21,
                  levels: int = 4) -> tuple[npt.NDArray[np.float32], Mask]:
    """Track points from one image to the next by pyramidal Lucas-Kanade, and back as a check.

    Returns the (n, 2) positions in `after` and (n,) whether each can be trusted.
    """
    if len(points) == 0:
        return points, np.zeros(0, bool)
    height, width = after.shape
    # cv2's stubs know neither the optional output nor what comes out
    flow: Any = cv2.calcOpticalFlowPyrLK
    settings = {'winSize': (window, window),
                'criteria': (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 0.03)}
    moved, ahead, _ = flow(before, after, points, None, maxLevel=levels, **settings)
    # the way back starts where it should end: a wrong match still leads elsewhere, at a fifth of
    # the time of a search from afar
    back, behind, _ = flow(after, before, moved, points.copy(), maxLevel=0,
                           flags=cv2.OPTFLOW_USE_INITIAL_FLOW, **settings)
    x, y = moved[:, 0], moved[:, 1]
    trusted = (
        (ahead.ravel() > 0) & (behind.ravel() > 0)
        & (np.linalg.norm(back - points, axis=1) < forward_backward_px)
        & (x > BORDER) & (x < width - 1 - BORDER) & (y > BORDER) & (y < height - 1 - BORDER))
    return moved, trusted
