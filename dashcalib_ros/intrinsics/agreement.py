"""Are the turns of one camera? What each says when it is asked alone."""
from __future__ import annotations

from collections.abc import Mapping, Sequence, Set

import numpy as np

from dashcalib_ros.config import VerdictConfig
from dashcalib_ros.intrinsics.information import noise_of
from dashcalib_ros.intrinsics.solution import Solution
from dashcalib_ros.reconstruction.camera import Camera
from dashcalib_ros.reconstruction.scene import Scene, truncated_cost

# px^2; what is explained better than this is explained perfectly
LEAST_COST = 0.01
# turns that know less of fx than this know nothing of it, and none of them more than the others
LEAST_SHARE = 1e-9


def misfits(alone: Sequence[Scene], together: Sequence[Scene], camera: Camera, limit_px: float
            ) -> dict[int, float]:
    """Return by how much the common camera explains each turn worse than its own, by centre.

    alone: the turns as they were reconstructed, each with a camera of its own (one focal length,
    k1, k2). together: those that are left, adjusted with the common camera. limit_px: where
    squared errors are cut. The ratio of the costs over all observations, about 1 or less for a
    turn of the common camera; one that it does not explain at all costs the limit.
    """
    adjusted = {scene.center: scene for scene in together}

    def cost(scene: Scene, camera: Camera) -> float:
        return max(truncated_cost(scene, camera, limit_px), LEAST_COST)

    return {scene.center: (cost(adjusted[scene.center], camera) if scene.center in adjusted
                           else limit_px**2) / cost(scene, scene.camera) for scene in alone}


def strangers(misfits: Mapping[int, float], config: VerdictConfig) -> set[int]:
    """Return the centres of the turns that another camera explains far better than the common one.

    A robust loss takes no notice of such turns: they cause no scatter.
    """
    return {center for center, misfit in misfits.items() if not misfit <= config.max_misfit}


def evidence_of(solution: Solution | None, config: VerdictConfig) -> set[int]:
    """Return the turns that keep their places: those used, and those of another camera.

    Without the latter nobody would know of it.
    """
    if solution is None:
        return set()
    return {scene.center for scene in solution.scenes} | strangers(solution.misfits, config)


def outdated(turns: Set[int], odd: Set[int]) -> set[int]:
    """Return which turns are not of the present camera, as far as the newest ones tell.

    turns: centres in order of time; those of earlier drives are negative. odd: the strangers among
    them. The newest turn shows the present camera, unless it is odd and alone in that: it may as
    well have been traffic.
    """
    newest = sorted(turns)[-2:]
    if newest and newest[-1] not in odd:
        return set(odd)
    return set(turns - odd) if len(newest) == 2 and odd >= set(newest) else set()


def focal_disagreement(solution: Solution) -> float:
    """Return the weighted scatter between the turns' own fx, relative to fx."""
    if len(solution.parts) < 2:
        return 0.0
    noise = noise_of(solution.parts)
    weights, offsets = [], []
    for part in solution.parts:
        inverse = np.linalg.inv(part.hessian[:6, :6] / noise + solution.belief)
        offsets.append(float((inverse @ part.score[:6])[0] / noise))
        weights.append(1 / float(inverse[0, 0]))
    mean = np.average(offsets, weights=weights)
    scatter = np.average((np.array(offsets) - mean) ** 2, weights=weights)
    return float(np.sqrt(scatter) / solution.camera.fx)


def leverages(solution: Solution) -> dict[int, float]:
    """Return each turn's share in what the turns know of fx, by centre; together 1."""
    noise = noise_of(solution.parts)
    hessians = [part.hessian[:6, :6] / noise for part in solution.parts]
    inverse = np.linalg.inv(sum(hessians) + solution.belief)
    known = [float((inverse @ hessian)[0, 0]) for hessian in hessians]
    # what is believed beforehand is the rest
    total = max(sum(known), LEAST_SHARE)
    return {scene.center: share / total
            for scene, share in zip(solution.scenes, known, strict=True)}
