# SPDX-License-Identifier: Apache-2.0
"""How a camera bends the upright lines of the world: lines + camera -> Bend.

A straight line in the world and the camera's centre lie in a plane. Its picture is known when the
plane is: what is left between it and the points found is the bend. It owes nothing to motion, and
no camera's rotation or focal length can hide it. One number is sought: the k1 that makes the lines
straight, all else unchanged. (Straight lines have to be straight: Devernay and Faugeras 2001;
Santana-Cedres et al. 2017 calibrate dashcams by it alone.)
"""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dashcalib_ros.arrays import Floats, Ints
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.mapping import sensitivity
from dashcalib_ros.detect.edges import Lines
from dashcalib_ros.robust import cauchy_fit, jackknife, weighted_median


@dataclass(frozen=True)
class Bend:
    """What straight lines show about a camera's distortion.

    lines: number of lines measured; groups: number of groups of images that share no line.
    bend_px: RMS distance of their points from a straight line, weighted, px. k1: the change of the
    camera's k1 that makes them straight, all else unchanged; sigma: its standard deviation.
    camera_sigma: that of the same number by the camera's own covariance; None where it has none.
    picture_px: RMS motion of the pixels by that change, px, less what a rotation, other focal
    lengths and another centre make up for.
    """

    lines: int
    groups: int
    bend_px: float
    k1: float
    sigma: float
    camera_sigma: float | None
    picture_px: float

    def resized(self, px: float) -> Bend:
        """Return the same for pictures in which a pixel of these is px pixels wide."""
        return replace(self, bend_px=self.bend_px * px, picture_px=self.picture_px * px)

    @property
    def sigmas(self) -> float:
        """Return the difference of lines and camera, in standard deviations of both together."""
        return abs(self.k1) / self._both

    @property
    def _both(self) -> float:
        return float(np.hypot(self.sigma, self.camera_sigma or 0.0))

    @property
    def change(self) -> str:
        """Return the clause of what the lines ask for, with the sigma of both together."""
        return f'they would be straight with k1 changed by {self.k1:+.3f} ± {self._both:.3f}'


# place of k1 among the parameters, in every model
K1 = 4


@dataclass(frozen=True)
class _Measured:
    """Lines against a camera: residual (n, k) px across each, and its derivatives (n, k, p).

    The residual is what is left of the points after the best straight line; its derivatives are
    those by the camera's parameters. group: (n,) of images, from 0.
    """

    residual: Floats
    derivatives: Floats
    group: Ints

    @property
    def along(self) -> Floats:
        return np.asarray(self.derivatives[:, :, K1])


# px; the bend of the straightest line is no better known: pixels, and blur
LEAST_NOISE_PX = 0.03
# px; by so much all lines may be bent alike for other reasons: what is beside them, the filter,
# and what no lens model has. Good calibrations of real drives leave 0.09 (KITTI 07), 0.06 (03),
# 0.03 (ntu_campus) and 0.02 px (KITTI raw), rendered ones up to 0.02, also behind a windscreen
SYSTEMATIC_PX = 0.03
# with fewer lines, or groups of images, their own scatter is unknown
LEAST_LINES, LEAST_GROUPS = 20, 4

# s; see bend()
GROUP_S = 5.0


def bend(lines: Lines, camera: Camera, covariance: Floats | None = None,
         group_s: float = GROUP_S) -> Bend | None:
    """Return how the camera bends the lines; None where there are too few.

    lines: in pixels of the camera's pictures. covariance: (p, p) of the camera's parameters.
    group_s: images within this time may show the same line, and count as one measurement.
    """
    measured = _sensitive(_measured(lines, camera, group_s))
    groups = int(measured.group.max(initial=-1)) + 1
    if len(measured.group) < LEAST_LINES or groups < LEAST_GROUPS:
        return None
    along = measured.along
    squares = np.sum(along**2, axis=1)
    wanted = np.sum(along * measured.residual, axis=1) / squares
    rest = measured.residual - wanted[:, None] * along
    # a line that wavers is bent by as much for other reasons than the lens
    noise = np.hypot(LEAST_NOISE_PX, _rms(rest))
    information = squares / along.shape[1] / noise**2
    k1, weight = _location(wanted, information)
    px_by_k1 = float(np.sqrt(np.average(squares / along.shape[1], weights=weight)))
    sigma = float(np.hypot(_sigma(wanted, information, measured.group, groups),
                           SYSTEMATIC_PX / px_by_k1))
    return Bend(
        len(wanted), groups,
        float(np.sqrt(np.average(_rms(measured.residual)**2, weights=weight))), k1, sigma,
        _camera_sigma(measured, weight / squares, covariance), _picture_px(camera, k1))


# sine of 15 degrees; a line leaning more, with the camera's own lean, is not upright
UPRIGHT = 0.26
# of the larger of both ways in which a ray moves a pixel, squared; less is next to the fold
LEAST_SPREAD = 1e-4


def _measured(lines: Lines, camera: Camera, group_s: float) -> _Measured:
    """Return the upright lines that the camera sees all of, against it."""
    count = lines.points.shape[1]
    points = lines.points.astype(np.float64)
    rays = camera.rays(points)
    seen = np.isfinite(rays).all(axis=(1, 2))
    points, rays, stamps_s = points[seen], rays[seen], lines.stamps_s[seen]
    _, across, _ = camera.derivatives(rays.reshape(-1, 3))
    across = across.reshape(-1, count, 2, 3)
    least, most = np.moveaxis(np.linalg.eigvalsh(across @ across.transpose(0, 1, 3, 2)), 2, 0)
    clear = (least > LEAST_SPREAD * most).all(axis=1)
    points, rays, stamps_s = points[clear], rays[clear], stamps_s[clear]
    normal, tangents = _planes(rays, across[clear])
    # a plane through the vertical has a level normal
    upright = np.abs(normal[:, 1]) < UPRIGHT
    points, rays, stamps_s = points[upright], rays[upright], stamps_s[upright]
    normal, tangents = normal[upright], tangents[upright]
    # at the line itself: at the points, the derivatives would follow the residual
    rays = rays - np.sum(rays * normal[:, None], axis=2, keepdims=True) * normal[:, None]
    by_params, across, pixels = camera.derivatives(rays.reshape(-1, 3))
    slope = _slope(across.reshape(-1, count, 2, 3), normal)
    steep = np.linalg.norm(slope, axis=2)
    unit = slope / steep[:, :, None]
    residual = np.sum((points - pixels.reshape(points.shape)) * unit, axis=2)
    by_params = by_params.reshape(*points.shape, len(camera.names()))
    derivatives = np.einsum('nkc,nkcp->nkp', unit, by_params)
    lines_moves = (rays @ tangents) / steep[:, :, None]
    together = np.concatenate([residual[:, :, None], derivatives], axis=2)
    basis, _ = np.linalg.qr(lines_moves)
    together = together - basis @ (basis.transpose(0, 2, 1) @ together)
    return _Measured(together[:, :, 0], together[:, :, 1:], _groups(stamps_s, group_s))


# of the most sensitive line's
LEAST_SENSITIVITY = 1e-9


def _sensitive(measured: _Measured) -> _Measured:
    """Omit the lines that no k1 bends: those through the middle of the distortion."""
    squares = np.sum(measured.along**2, axis=1)
    sensitive = squares > LEAST_SENSITIVITY * squares.max(initial=0.0)
    return _Measured(measured.residual[sensitive], measured.derivatives[sensitive],
                     measured.group[sensitive])


# of the plane through a line's points, and of the weights
PLANE_STEPS, WEIGHT_STEPS = 3, 30


def _planes(rays: Floats, across: Floats) -> tuple[Floats, Floats]:
    """Return planes through rays (n, k, 3): normals (n, 3), and two directions (n, 3, 2) in each.

    across: (n, k, 2, 3) derivatives of the pixels by the rays. Distances count in pixels.
    """
    weight = np.ones(rays.shape[:2])
    for _ in range(PLANE_STEPS):
        moments = np.einsum('nk,nki,nkj->nij', weight, rays, rays)
        _, axes = np.linalg.eigh(moments)
        normal = axes[:, :, 0]
        weight = 1 / np.maximum(np.sum(_slope(across, normal)**2, axis=2), 1e-12)
    return normal, axes[:, :, 1:]


def _slope(across: Floats, normal: Floats) -> Floats:
    """Return (n, k, 2) by how much a ray leaves its plane for each pixel to the right and down.

    across: (n, k, 2, 3) derivatives of the pixels by the rays; normal: (n, 3).
    """
    both = across @ across.transpose(0, 1, 3, 2)
    moved = across @ normal[:, None, :, None]
    return np.asarray(np.linalg.solve(both, moved)[..., 0])


# each is omitted in turn; more cost time and change nothing
MOST_GROUPS = 40


def _groups(stamps_s: Floats, group_s: float) -> Ints:
    """Return the group (n,) of each line's image, from 0: images of so long a time are one.

    In a long drive several such times are joined.
    """
    times, group = np.unique(stamps_s // group_s, return_inverse=True)
    group = group.reshape(-1).astype(np.int64)
    return np.asarray(group * min(MOST_GROUPS, len(times)) // max(len(times), 1))


def _rms(values: Floats) -> Floats:
    return np.asarray(np.sqrt(np.mean(values**2, axis=1)))


def _location(wanted: Floats, information: Floats) -> tuple[float, Floats]:
    """Return the k1 of most lines, and the lines' weights (n,), for a Cauchy distribution.

    wanted: (n,) k1 of each line; information: (n,) inverse variances. What is curved in the world
    gives any k1, and hardly counts.
    """
    sigma = 1 / np.sqrt(information)
    start = weighted_median(wanted, 1 / sigma)
    found = cauchy_fit(np.ones((len(wanted), 1)), wanted, sigma, WEIGHT_STEPS, information,
                       np.array([start]))
    return float(found.params[0]), found.weights


def _sigma(wanted: Floats, information: Floats, group: Ints, groups: int) -> float:
    sigma = jackknife(lambda kept: np.array(_location(wanted[kept], information[kept])[0]),
                      group, groups)
    # of few groups it is uncertain itself: the wider t distribution, for as many
    return float(sigma * np.sqrt((groups - 1) / (groups - 3)))


def _camera_sigma(measured: _Measured, weight: Floats, covariance: Floats | None
                  ) -> float | None:
    """Return the standard deviation of the lines' k1 by the camera's covariance alone.

    weight: (n,) of the lines. An error of any parameter bends lines a little as k1 does.
    """
    if covariance is None:
        return None
    moved = np.einsum('n,nk,nkp->p', weight, measured.along, measured.derivatives)
    share = moved / moved[K1]
    return float(np.sqrt(max(share @ covariance @ share, 0.0)))


def _picture_px(camera: Camera, k1: float) -> float:
    """Return by how much (px, root mean square) another k1 bends the picture.

    Turns that are explained with another k1 have another focal length, too.
    """
    moves, pixels = sensitivity(camera)
    moves = moves.reshape(2 * len(pixels), -1)
    straight, by_k1 = moves[:, :K1], moves[:, K1]
    rest = by_k1 - straight @ np.linalg.lstsq(straight, by_k1, rcond=None)[0]
    return float(abs(k1) * np.linalg.norm(rest) / np.sqrt(len(pixels)))
