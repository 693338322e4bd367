"""The field that no lens model has (camera/field.py), estimated with the camera from all turns.

It is shared by all turns, and orthogonal to what the camera's parameters and a common rotation
do: so the camera stays the best one without it. Its terms have a normal prior, smaller for higher
degrees. How large it is, the evidence says (the marginal likelihood, each track counted about
once): a sound lens has none. The field is used only where turns that did not make it are
predicted better with it, and beyond what the wider lens model explains.
"""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.field import TERMS, Field, field_terms
from dashcalib_ros.camera.mapping import grid_of, sensitivity
from dashcalib_ros.reconstruct.scene import Scene, residuals_px

# px of 1000 px of width: sizes of the field among which the evidence chooses
SIZES = tuple(0.0125 * 2.0**n for n in range(9))
# singular values below this share of the largest: the camera cannot make such a field
LEAST_PART = 1e-3


@dataclass(frozen=True)
class FoundField:
    """A field, and the standard deviation of its prior.

    field: zero where turns do not confirm it: then it only makes sigma larger.
    basis: (2 len(TERMS), f) of its f free directions; the prior of each is sigma_px. inflation: of
    the noise, by errors that the observations of a track share: priors count as much more.
    """

    field: Field
    basis: Floats
    sigma_px: float
    inflation: float = 1.0

    @property
    def used(self) -> bool:
        """Return whether the turns confirm the field."""
        return bool(self.field.coefficients.any())

    @property
    def directions(self) -> Floats:
        """Return (f,) how far the field goes in each of its directions."""
        found, *_ = np.linalg.lstsq(self.basis, self.field.coefficients.ravel(), rcond=None)
        return np.asarray(found, np.float64)

    def columns(self, scene: Scene, camera: Camera) -> Floats:
        """Return (k, t, 2, f) derivatives of the observations by the field's free directions."""
        # where the points project to: the errors of observations would correlate with the terms
        pixels = scene.tracks.xy + residuals_px(scene, camera)
        return displacements(pixels, camera.image_size, self.basis)


def displacements(pixels: Floats, image_size: tuple[int, int], basis: Floats) -> Floats:
    """Return (..., 2, f) the fields of f directions (2 len(TERMS), f) at pixels (..., 2)."""
    terms, count = field_terms(pixels, image_size), len(TERMS)
    return np.stack([terms @ basis[:count], terms @ basis[count:]], axis=-2)


def without_field(scene: Scene, field: Field) -> Scene:
    """Return the scene with the tracks that the camera's model alone would have seen."""
    return replace(scene, tracks=replace(scene.tracks, xy=field.ideal(scene.tracks.xy)))


def field_basis(camera: Camera) -> Floats:
    """Return (2 len(TERMS), f) directions that no change of the camera and no rotation makes.

    They are scaled so that the prior of a field of size 1 is the unit matrix.
    """
    moves, pixels = sensitivity(camera)
    fields = displacements(pixels, camera.image_size, np.eye(2 * len(TERMS)))
    # rotations of the camera move all pixels, and sensitivity() leaves them out
    by_camera = np.concatenate([moves, _rotations(camera, pixels)], axis=2).reshape(
        -1, moves.shape[2] + 3)
    made, _ = np.linalg.qr(by_camera / np.linalg.norm(by_camera, axis=0))
    _, parts, rows = np.linalg.svd(made.T @ fields.reshape(len(made), -1))
    free = rows[int((parts > LEAST_PART * parts[0]).sum()):].T
    degree = np.maximum(np.array(TERMS).sum(axis=1) - 1, 1)
    precision = free.T * np.tile(degree.astype(np.float64)**2, 2) @ free
    return np.asarray(free @ np.linalg.inv(np.linalg.cholesky(precision)).T)


def _rotations(camera: Camera, pixels: Floats) -> Floats:
    """Return (m, 2, 3) by how much small rotations of the camera move pixels (m, 2)."""
    x, y, z = camera.rays(pixels).T
    _, by_point, _ = camera.derivatives(np.stack([x, y, z], axis=1))
    zero = np.zeros_like(x)
    turned = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3, 3)
    return np.asarray(by_point @ turned)


def grid_field(found: FoundField, camera: Camera) -> Floats:
    """Return (m, 2, f) the fields of its free directions at a grid over the picture."""
    return displacements(grid_of(camera), camera.image_size, found.basis)


@dataclass(frozen=True)
class Evidence:
    """The evidence for the field of the size that it favours, over that for none, in nats.

    inflation: of the noise, by the errors that the observations of a track share.
    """

    sigma_px: float
    nats: float
    inflation: float


@dataclass(frozen=True)
class FieldProblem:
    """The linearised problem of the lens, with its wider model, and of the field, at unit noise.

    hessians: (t, m, m), scores: (t, m), by_track: (t, m, m) of t turns about m parameters, the
    lens's first. prior: (l, l), pull: (l,) information and gradient of the lens's prior. at: (f,)
    the present field's directions, by which the tracks were moved already.
    """

    hessians: Floats
    scores: Floats
    by_track: Floats
    prior: Floats
    pull: Floats
    at: Floats

    def evidence(self, width: int) -> Evidence:
        """Return the evidence for the size of the field that it favours."""
        return max((self._evidence(size * width / 1000) for size in SIZES),
                   key=lambda each: each.nats)

    def _evidence(self, sigma_px: float) -> Evidence:
        inflation = self._inflation(sigma_px)
        hessian, score = self._own(self.hessians.sum(axis=0), self.scores.sum(axis=0), inflation)
        prior = np.eye(len(self.at)) / sigma_px**2
        _, size = np.linalg.slogdet(np.eye(len(self.at)) + sigma_px**2 * hessian)
        nats = 0.5 * (score @ np.linalg.solve(hessian + prior, score) - size)
        return Evidence(sigma_px, float(nats), inflation)

    def _inflation(self, sigma_px: float) -> float:
        """Return by how much errors that a track's observations share inflate the variances."""
        hessian = self.hessians.sum(axis=0)
        inverse = np.linalg.inv(hessian + self.information(sigma_px))
        return max(1.0, float(np.sum(inverse * self.by_track.sum(axis=0))
                              / np.sum(inverse * hessian)))

    def information(self, sigma_px: float) -> Floats:
        """Return (m, m) the information of the priors of the lens and of the field."""
        lens, size = len(self.pull), len(self.scores[0])
        prior = np.zeros((size, size))
        prior[:lens, :lens] = self.prior
        prior[lens:, lens:] = np.eye(size - lens) / sigma_px**2
        return prior

    def _own(self, hessian: Floats, score: Floats, inflation: float) -> tuple[Floats, Floats]:
        """Return hessian and score of the field (about no field), the lens at its optimum."""
        lens = len(self.pull)
        hessian, score = hessian / inflation, score / inflation
        mixed = np.linalg.solve(hessian[:lens, :lens] + self.prior, hessian[:lens, lens:])
        own = hessian[lens:, lens:] - hessian[lens:, :lens] @ mixed
        return own, score[lens:] - mixed.T @ (score[:lens] + self.pull) + own @ self.at

    def step(self, evidence: Evidence, narrow: int) -> Floats:
        """Return the step (m,) of all parameters; of the lens's only the first (narrow,) move."""
        lens, free = len(self.pull), np.r_[:narrow, len(self.pull):len(self.scores[0])]
        information = self.information(evidence.sigma_px)
        hessian = self.hessians.sum(axis=0) / evidence.inflation + information
        score = self.scores.sum(axis=0) / evidence.inflation
        score[:lens] += self.pull
        score[lens:] -= self.at / evidence.sigma_px**2
        step = np.zeros(len(score))
        step[free] = np.linalg.solve(hessian[np.ix_(free, free)], score[free])
        return step

    def held_out_gains(self, evidence: Evidence) -> Floats:
        """Return (t,) by how much the field of the other turns explains each turn better.

        Each turn's lens is free, with and without the field: so only what turns share counts.
        In noise variances of a track.
        """
        gains = []
        for n in range(len(self.scores)):
            others = np.arange(len(self.scores)) != n
            hessian, score = self._own(self.hessians[others].sum(axis=0),
                                       self.scores[others].sum(axis=0), evidence.inflation)
            field = np.linalg.solve(hessian + np.eye(len(self.at)) / evidence.sigma_px**2, score)
            hessian, score = self._own(self.hessians[n], self.scores[n], evidence.inflation)
            gains.append(float(2 * score @ field - field @ hessian @ field))
        return np.array(gains)
