# SPDX-License-Identifier: Apache-2.0
"""Textured rectangles -> picture, by casting the exact ray of every distorted pixel.

A rectangle's plane makes inverse depth w, and its texture coordinates times w, linear in the ray
(x, y, 1): three dot products per pixel decide visibility. Pixels on an outline are cast again
with four rays each. Textures are sampled once, from mip levels that fit the pixel's footprint.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from dashcalib_ros.arrays import Floats, Floats32, Ints
from dashcalib_ros.demo.atlas import LEVELS, Atlas
from dashcalib_ros.demo.lens import Lens
from dashcalib_ros.demo.quads import Quads

Singles = Floats32
Integers = npt.NDArray[np.intp]

NEAR_M = 0.05
# half the light is the air's at this distance
HAZE_M = 900.0
HAZE_GREY = 205.0
# inverse depth where there is nothing
FARTHEST = 1e-9
SUB_PIXELS = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))


class Raycaster:
    """Renders one lens; keeps the rays, and works frame by frame without any other state."""

    def __init__(self, lens: Lens, atlas: Atlas) -> None:
        self.lens = lens
        self.atlas = atlas
        # coordinate 0 lies half a texel before a texture's first centre
        table = atlas.table.reshape(-1, 4) - np.array((0.5, 0.5, 0.0, 0.0), np.float32)
        self.table = np.ascontiguousarray(table.T)
        self.x, self.y = self._rays((0.0, 0.0))
        self.sub_rays = [self._rays(offset) for offset in SUB_PIXELS]
        self.column_low, self.column_high = self.x.min(axis=0), self.x.max(axis=0)
        self.row_low, self.row_high = self.y.min(axis=1), self.y.max(axis=1)
        # a pixel's width across a plane at w = 1, and along it when the plane is 1 m away
        radius = np.hypot(self.x, self.y)
        square = radius * radius
        stretch = ((1.0 + square * (lens.k1 + square * lens.k2))
                   * (1.0 + square * (3.0 * lens.k1 + 5.0 * square * lens.k2)))
        pixel = 1.0 / (lens.fx * np.sqrt(np.maximum(stretch, 1e-3)))
        self.across = (np.sqrt(1.0 + square) * pixel).astype(np.float32)
        self.along = ((1.0 + square) * pixel).astype(np.float32)

    def render(self, quads: Quads, rotation: Floats, position: Floats) -> Singles:
        """Return the picture (height, width) float32, grey 0 to 255, without noise.

        rotation: world from camera, (1, 3, 3), or (height, 3, 3) when every row has its own.
        position: of the camera, (1, 3) or (height, 3) m.
        """
        planes = self._set_up(quads, rotation, position)
        w, s, t, index = self._visibility(planes)
        image = self._shade(planes, w, s, t, index, self.along, self.across)
        self._smooth_outlines(planes, index, image)
        return image

    # -- geometry ---------------------------------------------------------------------------

    def _set_up(self, quads: Quads, rotation: Floats, position: Floats) -> _Planes:
        """Cull what cannot be seen; return the rest as planes in the camera's frame."""
        middle = len(position) // 2
        normal = np.cross(quads.down, quads.right)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        level = np.sum(normal * quads.origin, axis=1)
        probes = sorted({0, middle, len(position) - 1})
        # not from behind, in any row
        seen = np.flatnonzero((position[probes] @ normal.T - level).min(axis=0) > 1e-3)
        low = np.full((seen.size, 2), np.inf)
        high = np.full((seen.size, 2), -np.inf)
        nearest = np.zeros(seen.size)
        for probe in probes:
            a, b, c = _extent(quads.take(seen), rotation[probe], position[probe])
            low, high = np.minimum(low, a), np.maximum(high, b)
            nearest = np.maximum(nearest, c)
        if len(probes) > 1:
            nearest *= 1.1
        nearest += 1e-6
        slack = 0.02 if len(probes) > 1 else 1e-6
        low, high = low - slack, high + slack
        boxes = np.stack([np.searchsorted(self.column_high, low[:, 0]),
                          np.searchsorted(self.column_low, high[:, 0], 'right'),
                          np.searchsorted(self.row_high, low[:, 1]),
                          np.searchsorted(self.row_low, high[:, 1], 'right')], axis=1)
        kept = (boxes[:, 0] < boxes[:, 1]) & (boxes[:, 2] < boxes[:, 3])
        seen, boxes, nearest = seen[kept], boxes[kept], nearest[kept]
        quads, normal = quads.take(seen), normal[seen]
        height = np.maximum(position @ normal.T - level[seen], 1e-4)
        wide = np.linalg.norm(quads.right, axis=1)
        high_m = np.linalg.norm(quads.down, axis=1)
        duals = (quads.right / wide[:, None] ** 2, quads.down / high_m[:, None] ** 2)
        feet = [position @ dual.T - np.sum(dual * quads.origin, axis=1) for dual in duals]
        # n . ray is negative in front of a plane; w = -(n . ray) / height
        turned = [_in_camera(vectors, rotation) for vectors in (normal, *duals)]
        inverse = -turned[0] / height.T[:, :, None]
        lines = np.empty((*inverse.shape[:2], 9), np.float32)
        lines[:, :, :3] = inverse
        for k in (0, 1):
            lines[:, :, 3 * k + 3:3 * k + 6] = turned[k + 1] + feet[k].T[:, :, None] * inverse
        size = self.atlas.table[quads.texture, 0, 2:]
        density = np.maximum(size[:, 0] / wide, size[:, 1] / high_m)
        scale = np.stack([density, 1.0 / height[middle], wide, high_m,
                          feet[0][middle], feet[1][middle]])
        return _Planes(lines, scale.astype(np.float32), quads.texture, boxes,
                       nearest.astype(np.float32))

    def _visibility(self, planes: _Planes) -> tuple[Singles, Singles, Singles, Integers]:
        """Return inverse depth, texture coordinates (0 to 1) and plane number (-1: none)."""
        shape = self.x.shape
        w_all = np.full(shape, FARTHEST, np.float32)
        s_all = np.zeros(shape, np.float32)
        t_all = np.zeros(shape, np.float32)
        index = np.full(shape, -1, np.int32)
        for number in np.argsort(-planes.nearest, kind='stable'):
            left, right, top, bottom = planes.boxes[number]
            area = np.s_[top:bottom, left:right]
            w_old = w_all[area]
            if w_old.min() >= planes.nearest[number]:
                continue
            x, y = self.x[area], self.y[area]
            line = planes.lines[number]
            if line.shape[0] > 1:
                line = line[top:bottom]
            w = _linear(line[:, 0:3], x, y)
            mask = w > w_old
            chosen = mask.view(np.uint8)
            if not cv2.countNonZero(chosen):
                continue
            s = _linear(line[:, 3:6], x, y)
            mask &= s >= 0.0
            mask &= s <= w
            t = _linear(line[:, 6:9], x, y)
            mask &= t >= 0.0
            mask &= t <= w
            for values, target in ((w, w_old), (s, s_all[area]), (t, t_all[area])):
                cv2.copyTo(values, chosen, target)
            np.copyto(index[area], np.int32(number), where=mask)
        s_all /= w_all
        t_all /= w_all
        return w_all, s_all, t_all, index.astype(np.intp)

    # -- colour -----------------------------------------------------------------------------

    def _shade(self, planes: _Planes, w: Singles, s: Singles, t: Singles, index: Integers,
               along: Singles, across: Singles) -> Singles:
        """Return the colours of pixels; all arrays (h, w), index -1 is empty air."""
        image = np.empty(w.shape, np.float32)
        # in bands that fit the processor's cache
        rows = max(1, 40000 // w.shape[1])
        for top in range(0, w.shape[0], rows):
            band = np.s_[top:top + rows]
            image[band] = self._shade_band(planes, w[band], s[band], t[band], index[band],
                                           along[band], across[band])
        return image

    def _shade_band(self, planes: _Planes, w: Singles, s: Singles, t: Singles, index: Integers,
                    along: Singles, across: Singles) -> Singles:
        """Sample every pixel's texture twice along its footprint, between two mip levels."""
        # -1 takes the last plane's numbers, which its distance hides in the haze
        density, closeness, wide, high, foot_s, foot_t = (
            values.take(index, mode='wrap') for values in planes.scale)
        depth = np.float32(1.0) / w
        minor = across * depth
        major = along * closeness
        major *= depth
        major *= depth
        level = np.maximum(minor, np.float32(0.5) * major)
        level *= density
        np.maximum(level, np.float32(1.0), out=level)
        level = np.asarray(cv2.log(level), np.float32)
        level *= np.float32(1.0 / np.log(2.0))
        np.minimum(level, np.float32(LEVELS - 1.001), out=level)
        whole = level.astype(np.intp)
        level -= whole
        # the footprint's long axis points away from the camera's foot on the plane
        s_away, t_away = s - foot_s, t - foot_t
        reach = np.asarray(cv2.magnitude(s_away * wide, t_away * high), np.float32)
        step = np.float32(0.25) * major / np.maximum(reach, np.float32(1e-3))
        s_away *= step
        t_away *= step
        zero, one = np.float32(0.0), np.float32(1.0)
        taps = [(np.clip(s - s_away, zero, one), np.clip(t - t_away, zero, one)),
                (np.clip(s + s_away, zero, one), np.clip(t + t_away, zero, one))]
        entry = planes.texture.take(index, mode='wrap') * LEVELS + whole
        sums: list[Singles] = []
        for below in (0, 1):
            x0, y0, columns, lines = (values.take(entry + below) for values in self.table)
            near, far = (cv2.remap(self.atlas.image, s_tap * columns + x0, t_tap * lines + y0,
                                   cv2.INTER_LINEAR) for s_tap, t_tap in taps)
            sums.append(np.add(near, far, dtype=np.float32))
        colour = sums[1]
        colour -= sums[0]
        colour *= level
        colour += sums[0]
        colour *= np.float32(0.5)
        clear = w * np.float32(HAZE_M)
        clear /= clear + one
        colour -= np.float32(HAZE_GREY)
        colour *= clear
        colour += np.float32(HAZE_GREY)
        return colour

    def _smooth_outlines(self, planes: _Planes, index: Integers, image: Singles) -> None:
        """Cast pixels on outlines again, with one ray through each quarter."""
        edge = np.zeros(index.shape, bool)
        across = index[:, 1:] != index[:, :-1]
        upright = index[1:] != index[:-1]
        edge[:, 1:] |= across
        edge[:, :-1] |= across
        edge[1:] |= upright
        edge[:-1] |= upright
        rows, columns = np.nonzero(edge)
        if not rows.size:
            return
        last_row, last_column = index.shape[0] - 1, index.shape[1] - 1
        candidates = (index[rows, columns],
                      index[np.maximum(rows - 1, 0), columns],
                      index[np.minimum(rows + 1, last_row), columns],
                      index[rows, np.maximum(columns - 1, 0)],
                      index[rows, np.minimum(columns + 1, last_column)])
        x, y = (np.stack([ray[axis][rows, columns] for ray in self.sub_rays]) for axis in (0, 1))
        w, s, t, best = _nearest(planes, candidates, rows, x, y)
        # folded like a picture: cv2.remap takes no rows of more than 32767
        shape = (-1, 256)
        pad = -best.size % shape[1]

        def fold(values: Any) -> Any:
            return np.pad(np.broadcast_to(values, best.shape).ravel(), (0, pad),
                          'edge').reshape(shape)

        colour = self._shade(planes, fold(w), fold(s), fold(t), fold(best),
                             fold(self.along[rows, columns]),
                             fold(self.across[rows, columns]))
        image[rows, columns] = colour.ravel()[:best.size].reshape(best.shape).mean(axis=0)

    def _rays(self, offset: tuple[float, float]) -> tuple[Singles, Singles]:
        """Return x and y (height, width) of the pixels' rays (x, y, 1), shifted by offset px."""
        lens = self.lens
        u, v = np.meshgrid(np.arange(lens.width) + offset[0], np.arange(lens.height) + offset[1])
        rays = lens.undistort(np.stack([u.ravel(), v.ravel()], axis=1)).astype(np.float32)
        shape = (lens.height, lens.width)
        return (np.ascontiguousarray(rays[:, 0]).reshape(shape),
                np.ascontiguousarray(rays[:, 1]).reshape(shape))


@dataclass(frozen=True)
class _Planes:
    """Visible rectangles in the camera's frame.

    lines: (n, 1 or height, 9): what times (x, y, 1) gives w, s w, t w. scale: (6, n): texels per
    metre, 1 / distance of the plane, width and height in m, and the camera's foot on the plane
    in texture coordinates. texture: (n,). boxes: (n, 4) left, right, top, bottom px.
    nearest: (n,) an upper bound of w.
    """

    lines: Singles
    scale: Singles
    texture: Ints
    boxes: Integers
    nearest: Singles


def _in_camera(vectors: Floats, rotation: Floats) -> Floats:
    """Return vectors (n, 3) in the camera's frame of every row: (n, rows, 3)."""
    rows = rotation.shape[0]
    stacked = rotation.transpose(1, 0, 2).reshape(3, 3 * rows)
    return np.asarray(vectors @ stacked).reshape(-1, rows, 3)


def _linear(line: Singles, x: Singles, y: Singles) -> Singles:
    """Return line . (x, y, 1); line is (1, 3) or (rows, 3)."""
    if line.shape[0] == 1:
        a, b, c = (float(value) for value in line[0])
        return np.asarray(cv2.addWeighted(x, a, y, b, c), np.float32).reshape(x.shape)
    total: Singles = x * line[:, 0:1]
    total += y * line[:, 1:2]
    total += line[:, 2:3]
    return total


def _nearest(planes: _Planes, candidates: Sequence[Integers], rows: Integers, x: Singles,
             y: Singles) -> tuple[Singles, Singles, Singles, Integers]:
    """Return inverse depth, texture coordinates and plane number where rays (k, n) hit first.

    candidates: arrays (n,) of plane numbers to try, -1 for none. rows: (n,) of the pixels.
    """
    per_plane = planes.lines.shape[1]
    lines = np.ascontiguousarray(planes.lines.reshape(-1, 9).T)
    own_row = rows if per_plane > 1 else 0
    w_all = np.full(x.shape, FARTHEST, np.float32)
    s_all, t_all = np.zeros_like(w_all), np.zeros_like(w_all)
    best = np.full(x.shape, -1, np.intp)
    for candidate in candidates:
        a = lines.take(np.maximum(candidate, 0) * per_plane + own_row, axis=1)
        w = a[0] * x + a[1] * y + a[2]
        mask = w > w_all
        mask &= candidate >= 0
        s = a[3] * x + a[4] * y + a[5]
        mask &= s >= 0.0
        mask &= s <= w
        t = a[6] * x + a[7] * y + a[8]
        mask &= t >= 0.0
        mask &= t <= w
        np.copyto(w_all, w, where=mask)
        np.copyto(s_all, s, where=mask)
        np.copyto(t_all, t, where=mask)
        np.copyto(best, candidate, where=mask)
    return w_all, s_all / w_all, t_all / w_all, best


def _extent(quads: Quads, rotation: Floats, position: Floats
            ) -> tuple[Floats, Floats, Floats]:
    """Return lowest and highest x and y (n, 2) of rays that may hit each rectangle, highest w."""
    a = (quads.origin - position) @ rotation
    right, down = quads.right @ rotation, quads.down @ rotation
    corners = np.stack([a, a + right, a + right + down, a + down], axis=1)
    following = np.roll(corners, -1, axis=1)
    z, z_next = corners[..., 2], following[..., 2]
    with np.errstate(divide='ignore', invalid='ignore'):
        share = (NEAR_M - z) / (z_next - z)
        crossing = corners + share[..., None] * (following - corners)
    crosses = (z < NEAR_M) != (z_next < NEAR_M)
    points = np.concatenate([corners, crossing], axis=1)
    valid = np.concatenate([z >= NEAR_M, crosses], axis=1)
    with np.errstate(divide='ignore', invalid='ignore'):
        rays = points[..., :2] / np.maximum(points[..., 2:], NEAR_M)
    low = np.where(valid[..., None], rays, np.inf).min(axis=1)
    high = np.where(valid[..., None], rays, -np.inf).max(axis=1)
    return low, high, 1.0 / np.maximum(z.min(axis=1), NEAR_M)
