"""The field that no lens model has (camera/field.py), estimated with the camera from all turns.

It is shared by all turns, and orthogonal to what the camera's parameters and a common rotation
do: so the camera stays the best one without it. Its terms have a normal prior, smaller for higher
degrees. How large it is, the evidence says (the marginal likelihood, each track counted about
once): a sound lens has none. The field is used only where turns that did not make it are
predicted better with it, and beyond what the wider lens model explains.
"""
from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.field import TERMS, Field, field_terms
from dashcalib_ros.camera.mapping import sensitivity, turned
from dashcalib_ros.reconstruct.scene import Scene, projected_px
from dashcalib_ros.solve.normal import Further
from dashcalib_ros.solve.quadratic import Quadratic

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

    def rms_over(self, camera: Camera) -> float:
        """Return how large the field is, px RMS; one that is not confirmed as its prior says."""
        if self.used:
            return float(np.sqrt(np.mean(self.field.over(camera)**2)))
        _, pixels = sensitivity(camera)
        one = displacements(pixels, camera.image_size, self.basis)
        return float(self.sigma_px * np.sqrt(np.mean(np.sum(one**2, axis=(1, 2)))))

    def further(self, camera: Camera) -> Further:
        """Return its directions as parameters that turns share."""
        # where the points project to: the errors of observations would correlate with the terms
        return Further(lambda scene: displacements(projected_px(scene, camera), camera.image_size,
                                                   self.basis),
                       np.full(self.basis.shape[1], self.sigma_px))


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
    rays = camera.rays(pixels)
    by_rotation = camera.derivatives(rays)[1] @ turned(rays)
    by_camera = np.concatenate([moves, by_rotation], axis=2).reshape(-1, moves.shape[2] + 3)
    made, _ = np.linalg.qr(by_camera / np.linalg.norm(by_camera, axis=0))
    _, parts, rows = np.linalg.svd(made.T @ fields.reshape(len(made), -1))
    free = rows[int((parts > LEAST_PART * parts[0]).sum()):].T
    degree = np.maximum(np.array(TERMS).sum(axis=1) - 1, 1)
    precision = free.T * np.tile(degree.astype(np.float64)**2, 2) @ free
    return np.asarray(free @ np.linalg.inv(np.linalg.cholesky(precision)).T)


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

    turns: the cost of each about the lens's parameters, then the field's. lens: the prior of the
    former. at: (f,) the present field's directions, by which the tracks were moved already.
    """

    turns: tuple[Quadratic, ...]
    lens: Quadratic
    at: Floats

    def evidence(self, width: int) -> Evidence:
        """Return the evidence for the size of the field that it favours."""
        return max((self._evidence(size * width / 1000) for size in SIZES),
                   key=lambda each: each.nats)

    def _evidence(self, sigma_px: float) -> Evidence:
        total = self._total
        inverse = Quadratic.together([total, self._prior(sigma_px)]).covariance
        # by how much errors that a track's observations share inflate the variances
        inflation = max(1.0, float(np.sum(inverse * total.by_track)
                                   / np.sum(inverse * total.hessian)))
        field = self._of_field(total, inflation)
        prior = np.eye(len(self.at)) / sigma_px**2
        _, size = np.linalg.slogdet(np.eye(len(self.at)) + sigma_px**2 * field.hessian)
        nats = 0.5 * (field.score @ np.linalg.solve(field.hessian + prior, field.score) - size)
        return Evidence(sigma_px, float(nats), inflation)

    @cached_property
    def _total(self) -> Quadratic:
        return Quadratic.together(self.turns)

    def _prior(self, sigma_px: float) -> Quadratic:
        """Return the prior of the lens and of a field of this size; inf: none of the field."""
        return Quadratic.prior(self.lens.hessian, np.full(len(self.at), 1 / sigma_px**2),
                               np.r_[self.lens.score, -self.at / sigma_px**2])

    def _of_field(self, cost: Quadratic, inflation: float) -> Quadratic:
        """Return the cost about the field, from where there is none, the lens at its optimum."""
        both = Quadratic.together([cost.at_noise(inflation), self._prior(np.inf)])
        return both.eliminated(len(self.lens.score)).moved(-self.at)

    def step(self, evidence: Evidence, narrow: int) -> Floats:
        """Return the step (m,) of all parameters; of the lens's only the first (narrow,) move."""
        total = Quadratic.together([self._total.at_noise(evidence.inflation),
                                    self._prior(evidence.sigma_px)])
        lens, step = len(self.lens.score), np.zeros(len(total.score))
        free = np.r_[:narrow, lens:len(step)]
        step[free] = total.of(free).optimum
        return step

    def gains_of_turns_left_out(self, evidence: Evidence) -> Floats:
        """Return (t,) by how much the field of the other turns explains each turn better.

        Each turn's lens is free, with and without the field: so only what turns share counts.
        In noise variances of a track.
        """
        prior = Quadratic.prior(np.eye(len(self.at)) / evidence.sigma_px**2)
        gains = []
        for n, turn in enumerate(self.turns):
            others = Quadratic.together([*self.turns[:n], *self.turns[n + 1:]])
            field = Quadratic.together([self._of_field(others, evidence.inflation), prior]).optimum
            gains.append(-self._of_field(turn, evidence.inflation).change(field))
        return np.array(gains)
