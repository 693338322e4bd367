"""Turns that show the same pictures: a bag that is played in a loop adds nothing but the first.

Two scenes are compared by what they are made of. Their yaw over time tells by how much one has to
be moved in time, forwards or backwards, to fit the other; then the places of their tracks tell
whether the pictures are the same. A second drive through the same bend has other pictures.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dashcalib_ros.arrays import Floats, Ints, Mask
from dashcalib_ros.reconstruction.scene import Scene
from dashcalib_ros.turns.turn import TurnId

# s between the offsets in time that are tried
OFFSET_S = 0.02
# two turns that share less have too little in common to be compared: of the shorter one
LEAST_OVERLAP = 0.25
# degrees; scatter of the difference of the yaw of two scenes with the same pictures
SAME_YAW_DEG = 0.5
# the yaw of the same turn in two reconstructions differs by this factor at the most
YAW_RATIO = 1.2
# px; how near a track must be to one of the other scene
NEAR_PX = 2.0
# the share of tracks that have one as near: chance alone gives 1 to 2 %, the same pictures 5
# (played backwards: other corners are followed) to 90 %
LEAST_SHARE, TIMES_CHANCE = 0.01, 2.5
# where tracks are moved to, to see what chance gives
DISPLACED_PX = (11.0, 7.0)
# tracks of a keyframe that are compared, at the most and at least
MOST_PLACES, FEWEST_PLACES = 100, 20
# keyframes that tell the offset in time, and how many offsets are tried
PROBES, MOST_OFFSETS = 5, 60
# of a turn's keyframes; with fewer new ones it is left out
LEAST_NEW = 0.5


def without_repeated(scenes: Sequence[Scene], min_images: int
                     ) -> tuple[list[Scene], dict[TurnId, TurnId]]:
    """Return the scenes without those that repeat an earlier one, and which turn each repeats.

    A scene of which at least half is new is cut to that. min_images: least keyframes of a scene.
    """
    kept: list[Scene] = []
    repeated: dict[TurnId, TurnId] = {}
    for n, scene in enumerate(scenes):
        # with those that were left out, too: backwards, a third turn may show it better
        for other in scenes[:n]:
            again = repeats(scene, other)
            new = scene.structure.registered & ~again
            if not again.any():
                continue
            count = int(new.sum())
            if count < max(min_images, LEAST_NEW * int(scene.structure.registered.sum())):
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
    for direction in (1.0, -1.0):
        offsets = _offsets(scene, other, direction)
        if not len(offsets):
            continue
        some = rows[np.linspace(0, len(rows) - 1, PROBES).astype(int)]
        # a steady turn fits in many places: tracks tell which one is right
        offset = max(offsets, key=lambda each: float(
            np.sum(_shares(scene, other, some, direction, each))))
        shares = _shares(scene, other, rows, direction, offset)
        by_chance = _shares(scene, other, rows, direction, offset, DISPLACED_PX)
        both = shares + by_chance > 0
        if both.any() and (shares[both].mean()
                           > LEAST_SHARE + TIMES_CHANCE * by_chance[both].mean()):
            again[rows[both]] = True
    return again


def _shares(scene: Scene, other: Scene, rows: Ints, direction: float, offset: float,
            displaced_px: tuple[float, float] = (0.0, 0.0)) -> Floats:
    """Return for each of these keyframes the share of its tracks that the other scene has, too.

    displaced_px: by how much the tracks are moved before: where pictures differ, that is all one.
    """
    times = direction * _seconds(scene) + offset
    return np.array([_share(scene.tracks.xy[row] + displaced_px, _places_at(other, times[row]))
                     for row in rows])


def _seconds(scene: Scene) -> Floats:
    """Return (k,) the keyframes' times since the first."""
    stamps = scene.tracks.stamps_ns
    return np.asarray((stamps - stamps[0]) / 1e9)


def _yaw_deg(scene: Scene) -> tuple[Floats, Floats]:
    """Return the times of the registered keyframes and the yaw there, degrees."""
    return _seconds(scene)[scene.structure.registered], scene.yaws_deg


def _offsets(scene: Scene, other: Scene, direction: float) -> Floats:
    """Return (n,) by how much the scene's time may be moved so that it fits the other's yaw, s.

    direction: -1 turns its time round.
    """
    times, yaw = _yaw_deg(scene)
    other_times, other_yaw = _yaw_deg(other)
    if len(times) < 2 or len(other_times) < 2:
        return np.zeros(0)
    times = direction * times
    reach = LEAST_OVERLAP * min(np.ptp(times), np.ptp(other_times))
    offsets = np.arange(other_times[0] - times.max() + reach,
                        other_times[-1] - times.min() - reach, OFFSET_S)
    moved = times + offsets[:, None]
    inside = (moved >= other_times[0]) & (moved <= other_times[-1])
    count = np.maximum(inside.sum(axis=1), 1)

    def centred(angles: Floats) -> Floats:
        mean = np.sum(angles * inside, axis=1) / count
        return np.asarray((angles - mean[:, None]) * inside)

    own = centred(np.broadcast_to(yaw, moved.shape))
    there = centred(np.interp(moved, other_times, other_yaw))
    # the focal lengths that the turns were reconstructed with differ, and their yaw with them
    slope = np.clip(np.sum(own * there, axis=1) / np.maximum(np.sum(there**2, axis=1), 1e-9),
                    1 / YAW_RATIO, YAW_RATIO)
    scatter = np.sqrt(np.sum((own - slope[:, None] * there)**2, axis=1) / count)
    # a stretch without yaw fits everywhere: the longer one of two is the better
    scatter = scatter * np.sqrt(len(times) / count)
    scatter[(count < 3) | (np.ptp(own, axis=1) < 2 * SAME_YAW_DEG)] = np.inf
    fitting = np.flatnonzero(scatter < SAME_YAW_DEG)
    best = fitting[np.argsort(scatter[fitting], kind='stable')[:MOST_OFFSETS]]
    return np.asarray(offsets[best])


def _places_at(scene: Scene, time: float) -> Floats:
    """Return (t, 2) where a scene's tracks are at a time, between two keyframes; NaN unseen."""
    times = _seconds(scene)
    after = int(np.searchsorted(times, time))
    # a keyframe that is as near as that counts as this picture
    if after == len(times) or (after == 0 and times[0] - time > OFFSET_S):
        return np.full((scene.tracks.xy.shape[1], 2), np.nan)
    if after == 0:
        return np.asarray(scene.tracks.xy[0])
    share = (time - times[after - 1]) / max(times[after] - times[after - 1], 1e-9)
    before, later = scene.tracks.xy[after - 1], scene.tracks.xy[after]
    return np.asarray((1 - share) * before + share * later)


def _share(places: Floats, others: Floats) -> float:
    """Return the share of places (t, 2) that have one of the others near; 0 where few are seen."""
    places = places[np.isfinite(places[:, 0])][:MOST_PLACES]
    others = others[np.isfinite(others[:, 0])]
    if len(places) < FEWEST_PLACES or len(others) < FEWEST_PLACES:
        return 0.0
    apart = np.square(places[:, None] - others).sum(axis=2).min(axis=1)
    return float(np.mean(apart < NEAR_PX**2))


def _cut(scene: Scene, rows: Mask) -> Scene:
    """Return the scene with these keyframes only."""
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
