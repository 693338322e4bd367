# SPDX-License-Identifier: Apache-2.0
"""Turns that show the same pictures: what is played again, forwards or backwards, adds nothing.

Two scenes are compared by what they are made of. Where their pictures are the same, tracks that
are near each other in the picture move alike over the next keyframes, whichever corners were
followed: they lie on the same surface, seen from the same places. Elsewhere hardly any do; nor on
a second drive through the same bend, on another path at another speed. The yaw over time tells by
how much one scene may be moved in time, forwards or backwards, to fit a part of the other.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dashcalib_ros.arrays import Floats, Ints, Mask
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.reconstruct.scene import MIN_KEYFRAMES, Scene

# s between the offsets in time that are tried; neighbouring tracks forgive half of it
OFFSET_S = 0.05
# keyframes over which tracks are compared: they move by a tenth of the width
SPAN = 3
# how many such spans two scenes must have in common
LEAST_SPANS = 2
# degrees; a span that turns less fits everywhere. The yaw of the same turn in two reconstructions
# differs by this factor, and by so many degrees, at most
LEAST_YAW_DEG, YAW_RATIO, SAME_YAW_DEG = 1.0, 1.2, 0.5
# spans that tell whether an offset is worth comparing all
PROBES = 3
# px; tracks as near as that lie on one surface, and those that move alike differ by so much
NEAR_PX, ALIKE_PX = 8.0, 1.5
# the share of near tracks that move alike, the mean of three spans: 0.8 to 1 in the same pictures,
# 0.33 at most in 100 pairs of other real turns, 0.3 at 4 % another speed through the same bend
LEAST_ALIKE = 0.5
# tracks of a span that are compared at most, and how many must be near another
MOST_TRACKS, FEWEST_NEAR = 60, 8
# of a turn's keyframes; with fewer new ones it is left out: one place counts once
LEAST_NEW = 0.75


def without_repeated(scenes: Sequence[Scene]) -> tuple[list[Scene], dict[TurnId, TurnId]]:
    """Return the scenes without those that repeat an earlier one, and which turn each repeats.

    A scene that is mostly new is cut to its new part.
    """
    kept: list[Scene] = []
    repeated: dict[TurnId, TurnId] = {}
    for n, scene in enumerate(scenes):
        whole = int(scene.structure.registered.sum())
        # with those that were left out, too: backwards, a third turn may show it better
        for other in scenes[:n]:
            again = repeats(scene, other)
            new = scene.structure.registered & ~again
            if not again.any():
                continue
            if new.sum() < max(MIN_KEYFRAMES, LEAST_NEW * whole):
                repeated[scene.turn] = repeated.get(other.turn, other.turn)
                break
            scene = _cut(scene, new)
        else:
            kept.append(scene)
    return kept, repeated


def repeats(scene: Scene, other: Scene) -> Mask:
    """Return (k,) which keyframes of a scene show pictures of the other one."""
    again = np.zeros(len(scene.tracks.frames), bool)
    if scene.tracks.image_size != other.tracks.image_size:
        return again
    rows = np.flatnonzero(scene.structure.registered)
    spans, seconds = _spans(scene, rows), _seconds(scene)[rows]
    for direction in (1.0, -1.0):
        for offset, turning in _offsets(scene, other, direction):
            times = direction * seconds + offset
            probes = turning[np.linspace(0, len(turning) - 1, PROBES).astype(int)]
            if not (_alike(spans, other, probes, times) > LEAST_ALIKE).any():
                continue
            share = _alike(spans, other, np.arange(len(spans)), times)
            # one span may agree by chance, not its neighbours, too
            same = np.flatnonzero(np.convolve(share, np.ones(3) / 3, 'same') > LEAST_ALIKE)
            if len(same) >= LEAST_SPANS:
                again[rows[np.unique(same[:, None] + np.arange(SPAN + 1))]] = True
    return again


def _spans(scene: Scene, rows: Ints) -> list[Floats]:
    """Return a few tracks (2, t, 2) at both ends of each span of registered keyframes, rows."""
    spans = []
    for ends in zip(rows, rows[SPAN:], strict=False):
        xy = _seen(scene.tracks.xy[list(ends)])
        spans.append(xy[:, ::max(1, xy.shape[1] // MOST_TRACKS)])
    return spans


def _seen(xy: Floats) -> Floats:
    return xy[:, np.isfinite(xy[:, :, 0]).all(axis=0)]


def _offsets(scene: Scene, other: Scene, direction: float) -> list[tuple[float, Ints]]:
    """Return by how much the scene's time may be moved so that it fits the other's yaw, s.

    direction: -1 turns its time round. Beside each stands which spans of the scene, (n,) by their
    first registered keyframe, turn as much there.
    """
    times, yaw = _yaw_deg(scene)
    other_times, other_yaw = _yaw_deg(other)
    if len(times) <= SPAN or len(other_times) < 2:
        return []
    times = direction * times
    offsets = np.arange(other_times[0] - times.max(), other_times[-1] - times.min(), OFFSET_S)
    begin, end = times[:-SPAN] + offsets[:, None], times[SPAN:] + offsets[:, None]
    inside = ((np.minimum(begin, end) >= other_times[0])
              & (np.maximum(begin, end) <= other_times[-1]))
    there = np.interp(end, other_times, other_yaw) - np.interp(begin, other_times, other_yaw)
    own = yaw[SPAN:] - yaw[:-SPAN]
    # the focal lengths that the turns were reconstructed with differ, and their yaw with them
    fits = inside & (np.abs(own) > LEAST_YAW_DEG) & (
        np.abs(there - own) < (YAW_RATIO - 1) * np.abs(own) + SAME_YAW_DEG)
    return [(float(offset), np.flatnonzero(each))
            for offset, each in zip(offsets, fits, strict=True) if each.sum() >= LEAST_SPANS]


def _alike(spans: Sequence[Floats], other: Scene, starts: Ints, times: Floats) -> Floats:
    """Return (n,) of the tracks near one of the other scene, the share that moves as that does.

    starts: (n,) the spans that are asked. times: (k,) when the other scene shows the registered
    keyframes. 0 where too few tracks are near one.
    """
    shares = np.zeros(len(starts))
    places = _places_at(other, times[starts[:, None] + (0, SPAN)])
    for n, (own, there) in enumerate(zip((spans[start] for start in starts), places, strict=True)):
        there = _seen(there)
        if not own.shape[1] or not there.shape[1]:
            continue
        # half the squared distance, without what is the same for all
        x, y = there[0].T
        nearest = ((x * x + y * y) / 2 - own[0] @ there[0].T).argmin(axis=1)
        before, after = own - there[:, nearest]
        near = np.hypot(*before.T) < NEAR_PX
        if np.count_nonzero(near) >= FEWEST_NEAR:
            shares[n] = np.mean(np.hypot(*(after - before)[near].T) < ALIKE_PX)
    return shares


def _seconds(scene: Scene) -> Floats:
    stamps = scene.tracks.stamps_ns
    return np.asarray((stamps - stamps[0]) / 1e9)


def _yaw_deg(scene: Scene) -> tuple[Floats, Floats]:
    return _seconds(scene)[scene.structure.registered], scene.yaws_deg


def _places_at(scene: Scene, at: Floats) -> Floats:
    """Return (..., t, 2) where a scene's tracks are at times (...) between two keyframes.

    NaN where they are not seen.
    """
    times, xy = _seconds(scene), scene.tracks.xy
    inside = np.clip(at, times[0], times[-1])
    after = np.maximum(np.searchsorted(times, inside), 1)
    share = (inside - times[after - 1]) / np.maximum(times[after] - times[after - 1], 1e-9)
    # a keyframe that is as near as that counts as this picture
    share = np.where(np.abs(at - inside) > OFFSET_S / 2, np.nan, share)[..., None, None]
    return np.asarray((1 - share) * xy[after - 1] + share * xy[after])


def _cut(scene: Scene, rows: Mask) -> Scene:
    tracks, structure = scene.tracks, scene.structure
    used = structure.used[rows]
    # a point needs two views
    used = used & (used.sum(axis=0) >= 2)
    return replace(
        scene, tracks=replace(tracks, frames=tracks.frames[rows], xy=tracks.xy[rows],
                              stamps_ns=tracks.stamps_ns[rows]),
        structure=replace(structure, rotations=structure.rotations[rows],
                          translations=structure.translations[rows],
                          registered=structure.registered[rows], used=used))
