# SPDX-License-Identifier: Apache-2.0
"""A turn's images -> tracks: the same world point followed through the keyframes.

Lucas-Kanade tracks replace the paper's SIFT matches: neighbouring images of a drive differ little,
so that tracking is exact to a part of a pixel, in a tenth of the time.
"""
from __future__ import annotations

from dataclasses import replace

import numpy as np

from dashcalib_ros.arrays import Floats, GreyImage, Ints, Mask
from dashcalib_ros.config import TracksConfig
from dashcalib_ros.detect.points import Tracking, find_corners, follow_points
from dashcalib_ros.detect.turn import Turn
from dashcalib_ros.problem.observations import Tracks

# keyframes; a track seen in fewer is dropped
MIN_LENGTH = 3
# px between two keyframes; a track that moves less stands still in the picture
STANDING_PX = 0.3
# s between two images; where more passes, points move farther than dense flow finds them: of steps
# of 100 px in 640 it loses half of the points that a pyramid of so many levels follows
DENSE_FLOW_S = 0.15
LEVELS = 4
# columns and rows in which tracks are to be seen in each keyframe
GRID = (6, 3)
# a keyframe comes at the latest when fewer of the last one's points live
KEYFRAME_OVERLAP = 0.6


def track_turn(turn: Turn, config: TracksConfig, valid: Mask | None = None) -> Tracks:
    """Follow corners through a turn and keep its keyframes.

    valid: (h, w), False where the ego vehicle is; None for everywhere.
    """
    images = [frame.image for frame in turn.frames]
    stamps_ns = np.array([frame.stamp_ns for frame in turn.frames], np.int64)
    near = len(images) < 2 or np.median(np.diff(stamps_ns)) < DENSE_FLOW_S * 1e9
    ids, frames, xy = _follow(images, Tracking(levels=None if near else LEVELS), config, valid)
    keyframes = _keyframes(ids, frames, xy, images[0].shape[1], config)
    rows = np.isin(frames, keyframes)
    names, columns = np.unique(ids[rows], return_inverse=True)
    table = np.full((len(keyframes), len(names), 2), np.nan)
    table[np.searchsorted(keyframes, frames[rows]), columns] = xy[rows]
    table = table[:, _worth_keeping(table)]
    indices = np.array([turn.frames[k].index for k in keyframes], dtype=np.int64)
    return Tracks(indices, table, turn.frames[0].size, stamps_ns[keyframes])


def thinned(tracks: Tracks, keyframes: int) -> Tracks:
    """Return the tracks with at most this many keyframes, evenly chosen."""
    count = len(tracks.frames)
    if count <= keyframes:
        return tracks
    kept = np.round(np.linspace(0, count - 1, keyframes)).astype(int)
    xy = tracks.xy[kept]
    return Tracks(tracks.frames[kept], xy[:, _worth_keeping(xy)], tracks.image_size,
                  tracks.stamps_ns[kept])


def longest(tracks: Tracks, wanted: int) -> Tracks:
    """Return as many tracks as wanted, those that are seen in the most keyframes."""
    length = tracks.seen.sum(axis=0)
    chosen = np.sort(np.argsort(-length, kind='stable')[:wanted])
    return replace(tracks, xy=tracks.xy[:, chosen])


def spread(tracks: Tracks, wanted: int) -> Tracks:
    """Return long tracks that are spread evenly over the keyframes and the picture.

    Keyframes lie closest in the middle of a turn, so the longest tracks do, too: with those alone,
    the poses at the turn's ends would be determined by few points.
    """
    seen = tracks.seen
    width, height = tracks.image_size
    columns, rows = GRID
    keyframe, track = np.nonzero(seen)
    x, y = tracks.xy[keyframe, track].T
    cell = (np.clip(x * columns / width, 0, columns - 1).astype(int)
            + columns * np.clip(y * rows / height, 0, rows - 1).astype(int))
    cells = keyframe * columns * rows + cell
    length = seen.sum(axis=0)
    order = np.argsort(-length, kind='stable')
    by_track = np.split(cells[np.argsort(track, kind='stable')], np.cumsum(length)[:-1])
    share = wanted * float(np.mean(length)) / (len(seen) * columns * rows)
    count = np.zeros(len(seen) * columns * rows)
    chosen: list[int] = []
    for n in order:
        if len(chosen) < wanted and np.mean(count[by_track[n]] < share) >= 0.5:
            count[by_track[n]] += 1
            chosen.append(int(n))
    spare = np.setdiff1d(order, chosen, assume_unique=True)
    spare = spare[np.argsort(-length[spare], kind='stable')]
    kept = np.sort([*chosen, *spare[:wanted - len(chosen)]]).astype(int)
    return replace(tracks, xy=tracks.xy[:, kept])


def _follow(images: list[GreyImage], tracking: Tracking, config: TracksConfig,
            valid: Mask | None) -> tuple[Ints, Ints, Floats]:
    """Return the observations as flat arrays: track (n,), image (n,), xy (n, 2)."""
    ids = np.zeros(0, np.int64)
    points = np.zeros((0, 2), np.float32)
    born = 0
    rows = []
    for k, image in enumerate(images):
        if k:
            points, trusted = follow_points(images[k - 1], image, points, tracking)
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


def _keyframes(ids: Ints, frames: Ints, xy: Floats, width: int,
               config: TracksConfig) -> Ints:
    """Return the keyframes: each is chosen by how far the points moved since the last one.

    A standing car adds none.
    """
    def observed(k: int) -> tuple[Ints, Floats]:
        rows = frames == k
        return ids[rows], xy[rows]

    if len(frames) == 0:
        return np.zeros(1, np.int64)
    # the first pictures may be black
    chosen = [int(frames[0])]
    last_ids, last_xy = observed(chosen[0])
    for k in range(chosen[0] + 1, int(frames.max()) + 1):
        now_ids, now_xy = observed(k)
        _, a, b = np.intersect1d(last_ids, now_ids, assume_unique=True, return_indices=True)
        moved = np.linalg.norm(now_xy[b] - last_xy[a], axis=1)
        survived = len(a) >= KEYFRAME_OVERLAP * len(last_ids)
        if survived and (len(a) == 0 or np.median(moved) < config.keyframe_motion * width):
            continue
        chosen.append(k)
        last_ids, last_xy = now_ids, now_xy
    return np.array(chosen, dtype=np.int64)


def _worth_keeping(table: Floats) -> Mask:
    """Return (t,): True for tracks that are seen in enough keyframes and move in the picture."""
    worth = np.isfinite(table[:, :, 0]).sum(axis=0) >= MIN_LENGTH
    xy = table[:, worth]
    extent = np.fmax.reduce(xy, axis=0) - np.fmin.reduce(xy, axis=0)
    # a track on burnt-in text stands still, and may jump from one letter to the next
    squares = np.sum(np.diff(xy, axis=0)**2, axis=2)
    standing = (squares < STANDING_PX**2).sum(axis=0) > 0.5 * np.isfinite(squares).sum(axis=0)
    worth[worth] = (np.hypot(*extent.T) > 2.0) & ~standing
    return np.asarray(worth, bool)
