"""A turn's images -> tracks: the same world point followed through the keyframes.

Lucas-Kanade tracks replace the paper's SIFT matches: neighbouring images of a drive differ little,
tracking is sub-pixel exact there, and it takes a tenth of the time.
"""
from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from dashcalib_ros.config import TracksConfig
from dashcalib_ros.turns.turn import Turn

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
# px; where the tracking window leaves the picture, positions drift
BORDER = 8
MIN_LENGTH = 3


@dataclass(frozen=True)
class Tracks:
    """Correspondences of one turn.

    frames: (k,) indices of the keyframes among the input's frames.
    xy: (k, t, 2) pixel coordinates (first pixel's centre at 0, 0), NaN where a track is not seen.
    image_size: (width, height).
    """

    frames: npt.NDArray[np.int64]
    xy: Array
    image_size: tuple[int, int]

    @property
    def seen(self) -> Mask:
        """Return (k, t): whether the track is seen in the keyframe."""
        return np.isfinite(self.xy[:, :, 0])


def track_turn(turn: Turn, config: TracksConfig, valid: Mask | None = None) -> Tracks:
    """Follow corners through a turn and keep its keyframes.

    valid: (h, w), False where the ego vehicle is; None for everywhere.
    """
    images = [frame.image for frame in turn.frames]
    ids, frames, xy = _follow(images, config, valid)
    keyframes = _keyframes(ids, frames, xy, images[0].shape[1], config)
    rows = np.isin(frames, keyframes)
    names, columns = np.unique(ids[rows], return_inverse=True)
    table = np.full((len(keyframes), len(names), 2), np.nan)
    table[np.searchsorted(keyframes, frames[rows]), columns] = xy[rows]
    table = table[:, _worth_keeping(table)]
    indices = np.array([turn.frames[k].index for k in keyframes], dtype=np.int64)
    return Tracks(indices, table, turn.frames[0].size)


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
            found.append(corners.reshape(-1, 2) + np.float32([left, top]))
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
    settings = {'winSize': (window, window), 'maxLevel': levels,
                'criteria': (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)}
    moved, ahead, _ = cv2.calcOpticalFlowPyrLK(before, after, points, None, **settings)
    back, behind, _ = cv2.calcOpticalFlowPyrLK(after, before, moved, None, **settings)
    x, y = moved[:, 0], moved[:, 1]
    trusted = (
        (ahead.ravel() > 0) & (behind.ravel() > 0)
        & (np.linalg.norm(back - points, axis=1) < forward_backward_px)
        & (x > BORDER) & (x < width - 1 - BORDER) & (y > BORDER) & (y < height - 1 - BORDER))
    return moved, trusted


def _follow(images: list[npt.NDArray[np.uint8]], config: TracksConfig, valid: Mask | None
            ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], Array]:
    """Return the observations as flat arrays: track (n,), image (n,), xy (n, 2)."""
    ids = np.zeros(0, np.int64)
    points = np.zeros((0, 2), np.float32)
    born = 0
    rows = []
    for k, image in enumerate(images):
        if k:
            points, trusted = follow_points(
                images[k - 1], image, points, config.forward_backward_px, config.window)
            if valid is not None and len(points):
                inside = np.round(points).astype(int)
                trusted &= valid[np.clip(inside[:, 1], 0, image.shape[0] - 1),
                                 np.clip(inside[:, 0], 0, image.shape[1] - 1)]
            ids, points = ids[trusted], points[trusted]
        if len(points) < 0.9 * config.points:
            corners = find_corners(image, points, config.points, valid)
            ids = np.concatenate([ids, born + np.arange(len(corners))])
            points = np.concatenate([points, corners])
            born += len(corners)
        rows.append((ids, np.full(len(ids), k), points.astype(np.float64)))
    tracks, frames, xy = (np.concatenate(column) for column in zip(*rows, strict=True))
    return tracks, frames, xy


def _keyframes(ids: npt.NDArray[np.int64], frames: npt.NDArray[np.int64], xy: Array, width: int,
               config: TracksConfig) -> npt.NDArray[np.int64]:
    """Choose keyframes by how far the points moved since the last one; a standing car adds none."""
    def observed(k: int) -> tuple[npt.NDArray[np.int64], Array]:
        rows = frames == k
        return ids[rows], xy[rows]

    chosen = [0]
    last_ids, last_xy = observed(0)
    for k in range(1, int(frames.max()) + 1):
        now_ids, now_xy = observed(k)
        _, a, b = np.intersect1d(last_ids, now_ids, assume_unique=True, return_indices=True)
        moved = np.linalg.norm(now_xy[b] - last_xy[a], axis=1)
        survived = len(a) >= config.keyframe_overlap * len(last_ids)
        if survived and (len(a) == 0 or np.median(moved) < config.keyframe_motion * width):
            continue
        chosen.append(k)
        last_ids, last_xy = now_ids, now_xy
    return np.array(chosen, dtype=np.int64)


def _worth_keeping(table: Array) -> Mask:
    """Return (t,): tracks seen in enough keyframes, and that are not fixed to the picture."""
    seen = np.isfinite(table[:, :, 0])
    with np.errstate(all='ignore'):
        low = np.min(np.where(seen[:, :, None], table, np.inf), axis=0)
        high = np.max(np.where(seen[:, :, None], table, -np.inf), axis=0)
    extent = np.linalg.norm(high - low, axis=1)
    return (seen.sum(axis=0) >= MIN_LENGTH) & (extent > 2.0)
