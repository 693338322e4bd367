"""Which camera model the turns prove: the one that foretells turns it was not fitted to.

Each turn is left out in turn. At a model's solution the cost of every turn is known as a quadratic
function of the camera's parameters (information.py), so that the camera without a turn, and what
it costs that turn, need no new adjustment. A model with too many parameters fits the other turns
better and the one left out worse: nothing has to be known of the number of parameters.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.reconstruct.scene import Scene, errors_px
from dashcalib_ros.solve.information import Information, Pooled, noise_of, pooled


@dataclass(frozen=True)
class Candidate:
    """A model that was tried.

    loses_by: how much worse than the chosen model it foretells the turns left out: the sum of the
    robust squared errors, in units of the noise of a track; 0 for the chosen one, negative for one
    that does better, but not clearly. apart_px: how far its camera is from the chosen one over the
    picture; None where they cannot be compared. chosen: it is the one that the turns choose.
    cost_ratio: its cost of the turns left out over that of the chosen one.
    """

    model: str
    loses_by: float
    apart_px: float | None = None
    chosen: bool = False
    cost_ratio: float = 1.0


def held_out_costs(scenes: Sequence[Scene], camera: Camera, parts: Sequence[Information],
                   prior: Floats, loss_px: float, limit_px: float) -> dict[TurnId, float]:
    """Return for each turn its cost with the camera of the other turns, px^2.

    parts, prior: at the solution. loss_px: of the Cauchy loss; errors above limit_px count as it.
    With one turn only, its cost with its own camera.
    """
    noise, together = noise_of(parts), pooled(parts, prior)
    total = np.linalg.inv(together.inverse)
    costs = {}
    for scene, hessian, score in zip(scenes, together.hessians, together.scores, strict=True):
        errors = np.minimum(errors_px(scene, camera), limit_px)[scene.tracks.seen]
        costs[scene.turn] = float(loss_px**2 * np.log1p(errors**2 / loss_px**2).sum())
        if len(scenes) > 1:
            step = -np.linalg.solve(total - hessian, score)
            costs[scene.turn] += noise * float(step @ hessian @ step - 2 * score @ step)
    return costs


def gain_of_wider_model(parts: Sequence[Information], prior: Floats, extra_sigma: Floats
                        ) -> Floats:
    """Return (n,) by how much the wider model foretells each turn better, at unit noise.

    extra_sigma: prior sigmas of its further coefficients. Both models' steps start from this
    model's solution; those of the narrower one leave the further coefficients at 0.
    """
    count, lens = len(prior), parts[0].lens
    noise = noise_of(parts)
    hessians = np.array([part.hessian[:lens, :lens] for part in parts]) / noise
    scores = np.array([part.score[:lens] for part in parts]) / noise
    wide = np.zeros((lens, lens))
    wide[:count, :count] = prior
    wide[count:, count:] = np.diag(1 / np.square(extra_sigma))
    # at the solution the prior balances the turns' scores
    balance = np.zeros(lens)
    balance[:count] = -scores[:, :count].sum(axis=0)
    gains = []
    for n, (hessian, score) in enumerate(zip(hessians, scores, strict=True)):
        others = [m for m in range(len(parts)) if m != n]
        normal = hessians[others].sum(axis=0) + wide
        pull = scores[others].sum(axis=0) + balance
        free = np.linalg.solve(normal, pull)
        held = np.zeros(lens)
        held[:count] = np.linalg.solve(normal[:count, :count], pull[:count])
        gains.append((held @ hessian @ held - 2 * score @ held)
                     - (free @ hessian @ free - 2 * score @ free))
    return np.array(gains)


def track_inflation(together: Pooled) -> float:
    """Return by how much errors that a track's observations share inflate the variances."""
    own = np.diag(together.inverse)
    return max(float(np.median(np.diag(together.clustered) / own)), 1.0)


def is_clear(gains: Floats, least: float) -> bool:
    """Return whether the gains (n,) of turns, in noise variances of a track, are clear evidence.

    They must be larger in sum than chance explains, and not come from one turn.
    """
    several = len(gains) < 2 or (np.sum(np.sort(gains)[:-1]) > 0
                                 and np.sum(gains > 0) > len(gains) / 2)
    return bool(gains.sum() > least and several)
