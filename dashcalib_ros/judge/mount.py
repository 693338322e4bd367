# SPDX-License-Identifier: Apache-2.0
"""How the camera sits on the car: yaw, pitch, roll and height, each with its sigma.

Yaw and pitch are those of the direction of travel: of pairs of images on straight stretches, and
of each turn's path where it does not bend. Roll is that of the plane of the path where it does
not bend (a body leans in bends), and of upright lines. Height is that of a turn's path above the
points over which the car drives, where speed is known. What the sources say is averaged; sigma
grows where they differ. A camera that looks back is measured against where the car comes from;
which of both it looks to, most pairs and turns decide, for a car seldom drives backwards.
"""
from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dashcalib_ros.arrays import Floats, Mask
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.camera import resized_pixels
from dashcalib_ros.camera.rotation import rotation_matrices, rotation_vectors
from dashcalib_ros.detect import Lines
from dashcalib_ros.detect.straights import Straights
from dashcalib_ros.errors import Notice
from dashcalib_ros.judge.calibration import MOVED_DEG, MOVED_SIGMAS, Mount
from dashcalib_ros.judge.monitor import HEADING_SIGMA_DEG, PITCH_SIGMA_DEG
from dashcalib_ros.reconstruct.heading import LEAST_YAW_DEG, heading
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.robust import (
    cauchy_fit,
    cauchy_weights,
    jackknife,
    mad_sigma,
    weighted_mean,
)
from dashcalib_ros.solve.solution import Solution


@dataclass(frozen=True)
class Speed:
    """at: m/s (n,) at stamps (n,), s. sigma: what it may be off by all along, a fraction."""

    at: Callable[[Floats], Floats]
    sigma: float



@dataclass(frozen=True)
class _Pairs:
    """What n pairs say. ahead: (n, 3) direction of travel halfway; sigma_deg, rate_deg_s: (n,).

    rear: (n,) where the car moves away from what the camera sees; ahead is the opposite of its
    direction then.
    """

    ahead: Floats
    sigma_deg: Floats
    rate_deg_s: Floats
    rear: Mask


# m/s^2; a body that brakes or gathers speed nods: where the speed is known, it is left out
MAX_ACCELERATION_M_S2 = 1.0
# degrees; what no source is better than: slopes, crowns and bumps, between places
HEADING_FLOOR_DEG, ROLL_FLOOR_DEG = 0.1, 0.3
# m above the road, and m/s: where speed is unknown, straight_m assumes a camera that high
USUAL_HEIGHT_M, USUAL_SPEED = 1.4, 10.0
# of pairs and turns; fewer do not decide which way the camera looks. KITTI's are unanimous,
# forwards and played backwards
MAJORITY = 0.75


def mount_of(straights: Straights, lines: Lines | None, solution: Solution, level: str,
             speed: Speed | None) -> Mount | None:
    """Return how the camera sits on the car; None where that is not known.

    straights, lines: in the scenes' pixels. level: the lens's verdict; the mount's is never
    better.
    """
    camera = solution.camera
    pairs = _poses_of_pairs(camera, _without_field(straights, solution))
    kept = _straight_pairs(pairs)
    # where the speed is not known, a second is the unit
    driven = speed or Speed(lambda stamps_s: np.ones(len(stamps_s)), 0.0)
    before_s, apart_s = straights.stamps_s - straights.apart_s, straights.apart_s
    faster = driven.at(straights.stamps_s) - driven.at(before_s)
    kept &= np.abs(faster) < MAX_ACCELERATION_M_S2 * apart_s
    roll = _roll(solution.scenes, lines, camera)
    scenes: Sequence[Scene] = solution.scenes
    change = _moved(pairs, kept, straights.stamps_s)
    moved_s = change and change[0]
    if moved_s is not None:
        # what was before is another mounting
        kept &= straights.stamps_s > moved_s
        scenes = [scene for scene in scenes if scene.turn.of_this_drive
                  and scene.tracks.stamps_ns[0] / 1e9 > moved_s]
        roll = _roll(scenes, lines and lines.chosen(lines.stamps_s > moved_s), camera)
    turned = float(np.radians(roll[0] if roll else 0.0))
    found = _heading(pairs, kept, scenes, turned)
    if found is None:
        return None
    angles, sigma, backwards = found
    rear = backwards > 0.5
    ahead = _direction(angles, turned)
    travel = resized_pixels(camera.project(ahead[None])[0], solution.px)
    own = np.degrees(solution.sigma[2:4] / solution.camera.params[:2])
    total = np.hypot(sigma, own)
    height = _height(scenes, driven, _direction(np.array([angles[0], angles[1] + 90.0]), turned))
    metres = float((apart_s * driven.at(before_s + apart_s / 2))[kept].sum() / 2)
    if speed is None:
        metres *= USUAL_SPEED if height is None else USUAL_HEIGHT_M / height[0]
        height = None
    reasons = _reasons(level, total, own, metres)
    if max(backwards, 1 - backwards) < MAJORITY:
        reasons += (Notice('E-MOUNT-DIRECTION', 'the car drove forwards and backwards, or stood, '
                           'too often to tell whether the camera looks ahead or back: drive '
                           'straight on for longer'),)
    return Mount(
        verdict='weak' if reasons else 'accepted', reasons=reasons,
        yaw_left_deg=math.remainder(angles[0] + 180 * rear, 360), pitch_up_deg=float(angles[1]),
        roll_right_deg=None if roll is None else roll[0],
        height_m=None if height is None else height[0],
        sigma={'yaw_left_deg': float(total[0]), 'pitch_up_deg': float(total[1]),
               'roll_right_deg': None if roll is None else roll[1],
               'height_m': None if height is None else height[1]},
        travel_px=(float(travel[0]), float(travel[1])),
        # on other roads it is elsewhere, however many places were averaged
        travel_sigma_px=float(solution.px * camera.fx * np.radians(
            np.hypot(np.hypot(*sigma) / np.sqrt(2), HEADING_FLOOR_DEG))),
        straight_m=metres, moved_s=moved_s)


# every fifth point of a pair is enough to see that a camera was moved
THINNED = 5


def moved(straights: Straights, camera: Camera) -> tuple[float, Floats] | None:
    """Return when and by how much a camera was moved on the car; None where it was not.

    That is a stamp, s, after which it points elsewhere, and (2,) degrees to the left and upwards.
    straights: in the camera's pixels.
    """
    some = replace(straights, before=straights.before[:, ::THINNED],
                   after=straights.after[:, ::THINNED])
    pairs = _poses_of_pairs(camera, some)
    return _moved(pairs, _straight_pairs(pairs), straights.stamps_s)


# degrees of yaw and of pitch; with more it is weak. openpilot's spread on one car is as large
MAX_SIGMA_DEG = 0.2


def _reasons(level: str, sigma: Floats, own: Floats, metres: float) -> tuple[Notice, ...]:
    """Return why a mount is weak. sigma, own: (2,) all of it, and what the lens's centre adds."""
    found = []
    if level != 'accepted':
        found.append(Notice('E-MOUNT-LENS', f'the lens is {level}'))
    if max(sigma) > MAX_SIGMA_DEG:
        remedy = ('drive more turns, to know the centre of the picture better'
                  if max(own) > MAX_SIGMA_DEG else 'drive straight on for longer')
        found.append(Notice(
            'E-MOUNT-SIGMA',
            f'yaw and pitch are known only to {max(sigma):.2f}° after {metres:.0f} m of straight '
            f'driving, {MAX_SIGMA_DEG:g}° or better is needed: {remedy}'))
    return tuple(found)


def _without_field(straights: Straights, solution: Solution) -> Straights:
    if solution.field is None:
        return straights
    ideal = solution.field.ideal
    return replace(straights,
                   before=np.asarray(ideal(straights.before.astype(np.float64)), np.float32),
                   after=np.asarray(ideal(straights.after.astype(np.float64)), np.float32))


# -- pairs of images ---------------------------------------------------------------------------

# of a pair's poses: steps of Gauss-Newton, and the loss in px, narrowing to what tracks need
STEPS, FIRST_PX, LAST_PX, NARROWING = 20, 3.0, 0.7, 0.8
# radians; the farthest a step goes
LONGEST_STEP = 0.1


def _poses_of_pairs(camera: Camera, straights: Straights) -> _Pairs:
    """Return the poses of all pairs at once: robust Gauss-Newton from straight ahead."""
    first, second = (camera.rays(np.asarray(each, np.float64))
                     for each in (straights.before, straights.after))
    seen = np.asarray(np.isfinite(first).all(axis=-1) & np.isfinite(second).all(axis=-1), bool)
    first, second = (np.where(seen[..., None], rays, (0.0, 0.0, 1.0)) for rays in (first, second))
    count, unit = len(straights), 1 / camera.fx
    turned = np.tile(np.eye(3), (count, 1, 1))
    # where the first image was taken, in the second one's frame
    back = np.tile((0.0, 0.0, -1.0), (count, 1))
    hessian, errors = np.tile(np.eye(5), (count, 1, 1)), np.zeros(seen.shape)
    weights = np.zeros(seen.shape)
    for step in range(STEPS):
        errors, slopes, tangents = epipolar(turned, back, first, second)
        loss = unit * max(LAST_PX, FIRST_PX * NARROWING**step)
        weights = seen * cauchy_weights(errors, loss)
        weighted = (weights[..., None] * slopes).transpose(0, 2, 1)
        hessian = weighted @ slopes + np.finfo(float).eps * np.eye(5)
        change = np.asarray(
            -np.linalg.solve(hessian, weighted @ errors[..., None])[..., 0], np.float64)
        length = np.maximum(np.linalg.norm(change, axis=1), np.finfo(float).tiny)
        change *= np.minimum(1.0, LONGEST_STEP / length)[:, None]
        turned = rotation_matrices(change[:, :3]) @ turned
        back = back + np.einsum('nk,nki->ni', change[:, 3:], tangents)
        back /= np.linalg.norm(back, axis=1)[:, None]
    noise = np.array([mad_sigma(row[valid]) if valid.any() else np.inf
                      for row, valid in zip(errors, seen, strict=True)])
    variance = np.linalg.inv(hessian)[:, [3, 4], [3, 4]].mean(axis=1)
    vector = rotation_vectors(turned)
    ahead = -(rotation_matrices(-vector / 2) @ back[:, :, None])[:, :, 0]
    # no epipolar plane tells forwards from backwards: with the wrong one, points are behind
    moved = first @ turned.transpose(0, 2, 1)
    depth = np.sum(np.cross(back[:, None], moved) * np.cross(second, moved), axis=-1)
    rear = ahead[:, 2] * np.sum(weights * depth, axis=1) < 0
    return _Pairs(ahead * np.sign(ahead[:, 2:]), np.degrees(noise * np.sqrt(variance)),
                  np.degrees(vector[:, 1]) / straights.apart_s, np.asarray(rear, bool))


def epipolar(turned: Floats, back: Floats, first: Floats, second: Floats
              ) -> tuple[Floats, Floats, Floats]:
    """Return rays' errors, their slopes by (turn, direction), and the directions' tangents.

    The error is the angle between a ray and the epipolar plane, averaged over both images.
    """
    moved = first @ turned.transpose(0, 2, 1)
    normal = np.cross(back[:, None], moved)
    other = np.cross(second, back[:, None])
    size = np.maximum(np.sqrt((np.sum(normal**2, -1) + np.sum(other**2, -1)) / 2), 1e-3)
    errors = np.sum(second * normal, axis=-1) / size
    aside = np.cross(back, np.where(np.abs(back[:, :1]) < 0.9, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    aside /= np.linalg.norm(aside, axis=1)[:, None]
    tangents = np.stack([aside, np.cross(back, aside)], axis=1)
    slopes = np.concatenate([np.cross(moved, other),
                             np.cross(moved, second) @ tangents.transpose(0, 2, 1)], axis=-1)
    return errors, slopes / size[..., None], tangents


# -- yaw and pitch -----------------------------------------------------------------------------

# pairs are judged in so many blocks: neighbours share tracks and bumps
BLOCKS, LEAST_PAIRS = 12, 8


def _heading(pairs: _Pairs, kept: Mask, scenes: Sequence[Scene], roll: float
             ) -> tuple[Floats, Floats, float] | None:
    """Return (2,) yaw and pitch, degrees, and their sigmas without those of the lens.

    And the share of pairs and turns in which the car moves away from what the camera sees: beyond
    a half the angles are against where the car comes from.
    """
    values, sigmas, rear = [], [], list(pairs.rear[kept])
    if kept.sum() >= LEAST_PAIRS:
        value, sigma = _heading_of_pairs(pairs, kept, roll)
        values.append(value)
        sigmas.append(sigma)
    for scene in scenes:
        found = heading(scene)
        if found is not None:
            level = _angles(_direction(np.array([found.yaw_deg, found.pitch_deg]), 0.0)[None],
                            roll)[0]
            values.append(level)
            rear.append(found.rear)
            sigmas.append(np.hypot([found.yaw_sigma_deg, found.pitch_sigma_deg],
                                   [HEADING_SIGMA_DEG, PITCH_SIGMA_DEG]))
    if not values:
        return None
    both = [_averaged(np.array(values)[:, n], np.array(sigmas)[:, n], HEADING_FLOOR_DEG)
            for n in range(2)]
    return (np.array([value for value, _ in both]), np.array([sigma for _, sigma in both]),
            float(np.mean(rear)))


# degrees; pairs that know their direction worse are left out, and what varies from pair to pair:
# bumps, and tracks that share errors
MOST_PAIR_SIGMA, PAIR_SCATTER_DEG = 1.0, 0.2


def _heading_of_pairs(pairs: _Pairs, kept: Mask, roll: float) -> tuple[Floats, Floats]:
    """Return (2,) yaw and pitch, degrees, of these pairs, and their sigmas (jackknife)."""
    angles, rate = _angles(pairs.ahead[kept], roll), pairs.rate_deg_s[kept]
    weights = 1 / (pairs.sigma_deg[kept]**2 + PAIR_SCATTER_DEG**2)
    blocks = np.arange(len(weights)) * BLOCKS // len(weights)
    return _at_no_rate(angles, rate, weights), jackknife(
        lambda some: _at_no_rate(angles[some], rate[some], weights[some]),
        blocks, int(blocks.max()) + 1)


# degrees a second; beyond it a stretch is not straight (openpilot's limit, too)
STRAIGHT_DEG_S = 2.0


def _straight_pairs(pairs: _Pairs) -> Mask:
    return np.asarray((np.abs(pairs.rate_deg_s) < STRAIGHT_DEG_S)
                      & (pairs.sigma_deg < MOST_PAIR_SIGMA), bool)


# pairs on either side of the moment in which a camera was moved; degrees, by which one may seem
# to point elsewhere on other roads (KITTI 03 by 0.5 between its ends), and beyond which single
# pairs do not count
LEAST_SIDE, PLACES_DEG, OUTLIER_DEG = 20, 0.15, 2.0


def _moved(pairs: _Pairs, kept: Mask, stamps_s: Floats) -> tuple[float, Floats] | None:
    """Return what moved() does. The place where both sides differ most is asked."""
    places = np.flatnonzero(kept)
    if len(places) < 2 * LEAST_SIDE:
        return None
    angles = _angles(pairs.ahead[kept], 0.0)
    middle = np.median(angles, axis=0)
    angles = np.clip(angles, middle - OUTLIER_DEG, middle + OUTLIER_DEG)
    splits = range(LEAST_SIDE, len(places) - LEAST_SIDE + 1)
    apart = [np.abs(angles[:n].mean(axis=0) - angles[n:].mean(axis=0)).max()
             * np.sqrt(n * (len(places) - n)) for n in splits]
    split = splits[int(np.argmax(apart))]
    sides = [np.isin(np.arange(len(kept)), part) for part in (places[:split], places[split:])]
    (before, its_sigma), (after, sigma) = (_heading_of_pairs(pairs, side, 0.0) for side in sides)
    floor = np.sqrt(2) * PLACES_DEG
    limit = np.maximum(MOVED_DEG, MOVED_SIGMAS * np.sqrt(its_sigma**2 + sigma**2 + floor**2))
    if (np.abs(after - before) <= limit).all():
        return None
    return float(stamps_s[places[split - 1]]), after - before


# of new weights
ROUNDS = 20
# a smaller scatter is rounding
EPSILON = float(np.finfo(float).eps)


def _at_no_rate(angles: Floats, rate: Floats, weights: Floats) -> Floats:
    """Return robust yaw and pitch (2,): a camera ahead of the rear axle moves aside in a bend."""
    one = np.ones(len(rate))
    return np.array([cauchy_fit(
        np.column_stack(columns), angle, lambda off: 2 * max(mad_sigma(off), EPSILON), ROUNDS,
        weights).params[0] for columns, angle in (([one, rate], angles[:, 0]),
                                                  ([one], angles[:, 1]))])


def _angles(ahead: Floats, roll: float) -> Floats:
    """Return (n, 2) yaw to the left and pitch upwards, degrees, of an axis z; ahead: (n, 3)."""
    x = np.cos(roll) * ahead[:, 0] - np.sin(roll) * ahead[:, 1]
    y = np.sin(roll) * ahead[:, 0] + np.cos(roll) * ahead[:, 1]
    return np.asarray(np.degrees(np.column_stack([
        np.arctan2(x, ahead[:, 2]), np.arcsin(np.clip(y, -1, 1))])))


def _direction(angles: Floats, roll: float) -> Floats:
    """Return the direction (3,) that has these angles (2,), degrees: the inverse of _angles()."""
    yaw, pitch = np.radians(angles)
    x, y, z = np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)
    return np.array([np.cos(roll) * x + np.sin(roll) * y, np.cos(roll) * y - np.sin(roll) * x, z])


def _averaged(values: Floats, sigmas: Floats, floor: float) -> tuple[float, float]:
    """Return the mean of sources, none of which is better than floor, and its sigma."""
    mean = weighted_mean(values, sigmas**2 + floor**2)
    return mean.value, float(np.sqrt(mean.widened))


# -- roll and height ---------------------------------------------------------------------------

# degrees; no source sees it, and none makes it less: on a crowned road a car leans to the kerb by
# 1.15 degrees (2 %), against its path and against what is upright
CROWN_DEG = 0.6
# upright lines, and the loss in radians
LEAST_LINES, LINE_LOSS = 100, 0.05


def _roll(scenes: Sequence[Scene], lines: Lines | None, camera: Camera
          ) -> tuple[float, float] | None:
    """Return the roll to the right and its sigma, degrees; None where nothing tells it."""
    found = [each for scene in scenes if (each := roll_of_path(scene)) is not None]
    if lines is not None and len(lines) >= LEAST_LINES:
        found.append(_roll_of_lines(lines, camera))
    if not found:
        return None
    # on a slope upright lines are off by it, and turns' paths are not: the odd ones out count less
    odd = np.abs(np.array(found) - np.median(found))
    roll, sigma = _averaged(np.array(found), odd / 2, ROLL_FLOOR_DEG)
    return roll, float(np.hypot(sigma, CROWN_DEG))


# of a path's largest bend, below which it is straight
UNBENT = 0.3


def roll_of_path(scene: Scene) -> float | None:
    """Return the roll against the plane of a turn's path, where it does not bend, degrees."""
    if abs(scene.yaw_deg) < LEAST_YAW_DEG:
        return None
    rotations, centres = scene.structure.path()
    normal = np.linalg.svd(centres - centres.mean(axis=0), full_matrices=False)[2][2]
    up = rotations @ normal
    up *= -np.sign(np.median(up[:, 1]))
    bend = _bend(rotations, centres)
    at = np.concatenate([bend[:1], (bend[1:] + bend[:-1]) / 2, bend[-1:]])
    straight = at < UNBENT * at.max()
    if not straight.any():
        return None
    return float(np.median(np.degrees(np.arctan2(-up[straight, 0], -up[straight, 1]))))


def _bend(rotations: Floats, centres: Floats) -> Floats:
    """Return (n - 1,) how much a path bends from image to image, radians per unit of way."""
    steps = rotations[1:] @ rotations[:-1].transpose(0, 2, 1)
    length = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    return np.asarray(np.abs(steps[:, 0, 2]) / np.maximum(length, np.finfo(float).tiny))


def _roll_of_lines(lines: Lines, camera: Camera) -> float:
    """Return the roll at which upright lines are parallel to the vertical, degrees."""
    rays = camera.rays(np.asarray(lines.points[:, [0, -1]], np.float64))
    rays = rays[np.isfinite(rays).all(axis=(1, 2))]
    normals = np.cross(rays[:, 0], rays[:, 1])
    lengths = np.linalg.norm(normals, axis=1)
    normals /= lengths[:, None]
    # upwards is (x, -1, z), across all normals
    found = cauchy_fit(normals[:, [0, 2]], normals[:, 1],
                       lambda off: min(mad_sigma(off) + EPSILON, LINE_LOSS), ROUNDS,
                       np.minimum(lengths / np.median(lengths), 3.0)**2, np.zeros(2), power=2)
    return float(np.degrees(np.arctan2(-found.params[0], 1.0)))


# of height: what turns differ by, and what all may share: slopes, and the load of the car
TURN_SCATTER, HEIGHT_FLOOR = 0.01, 0.01


def _height(scenes: Sequence[Scene], speed: Speed, down: Floats) -> tuple[float, float] | None:
    """Return the height above the road, m, and its sigma; None where no turn shows it.

    down: (3,) in the camera's frame.
    """
    found = [each for scene in scenes if (each := _height_in_turn(scene, speed, down)) is not None]
    if not found:
        return None
    logs, sigmas = np.array(found).T
    log, sigma = _averaged(logs, sigmas, TURN_SCATTER)
    return float(np.exp(log)), float(np.exp(log) * math.hypot(sigma, HEIGHT_FLOOR, speed.sigma))


def _height_in_turn(scene: Scene, speed: Speed, down: Floats) -> tuple[float, float] | None:
    """Return the logarithm of the height of a path above the road under it, m, and its sigma."""
    structure, found = scene.structure, log_height(scene, down)
    if found is None:
        return None
    rotations, centres = structure.path()
    stamps_s = scene.tracks.stamps_ns[structure.registered] / 1e9
    # in a bend the camera is faster than what measures the speed
    bend, ways = _bend(rotations, centres), np.linalg.norm(np.diff(centres, axis=0), axis=1)
    metres = speed.at((stamps_s[1:] + stamps_s[:-1]) / 2) * np.diff(stamps_s)
    # before and after the sensor's samples the speed is 0
    straight = (bend < UNBENT * bend.max()) & (metres > 0)
    if not straight.any():
        return None
    return found[0] + float(np.log(metres[straight].sum() / ways[straight].sum())), found[1]


# times the height to the side of the path: the road between the wheels; images that see a point
ROADWAY, LEAST_SEEN, LEAST_ROAD_POINTS = 1.0, 3, 8


def log_height(scene: Scene, down: Floats) -> tuple[float, float] | None:
    """Return the logarithm of the height of a path above the road under it, and its sigma.

    In the scene's unit; None where too little of the road was seen. down: (3,) in the camera's
    frame.
    """
    structure = scene.structure
    rotations, centres = structure.path()
    ways = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    ahead = np.gradient(centres, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1)[:, None]
    down = (rotations.transpose(0, 2, 1) @ down).mean(axis=0)
    seen = structure.used.sum(axis=0) >= LEAST_SEEN
    offsets = structure.points[seen] - centres[:, None]
    level = offsets - (offsets @ down)[..., None] * down
    nearest = np.argmin(np.linalg.norm(level, axis=2), axis=0)
    offset, ahead = offsets[nearest, np.arange(len(nearest))], ahead[nearest]
    along = np.sum(offset * ahead, axis=1)
    across = offset - along[:, None] * ahead
    depth = across @ down
    aside = np.linalg.norm(across - depth[:, None] * down, axis=1)
    road = (depth > 0) & (aside < ROADWAY * depth) & (np.abs(along) < ways.max())
    if road.sum() < LEAST_ROAD_POINTS:
        return None
    logs = np.log(depth[road])
    middle = float(np.median(logs))
    return middle, mad_sigma(logs - middle) / np.sqrt(len(logs))
