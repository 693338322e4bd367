"""Solution and evidence -> the Calibration that is given to the user."""
from __future__ import annotations

import platform
from dataclasses import dataclass
from importlib import metadata

import numpy as np
import numpy.typing as npt

from dashcalib_ros.config import Config
from dashcalib_ros.intrinsics.agreement import focal_disagreement
from dashcalib_ros.intrinsics.calibration import (
    Calibration,
    Intrinsics,
    Shutter,
    StoredTurnSummary,
    TurnSummary,
    Verdict,
)
from dashcalib_ros.intrinsics.solution import Solution
from dashcalib_ros.intrinsics.verdict import judge, profile_contrast
from dashcalib_ros.reconstruction.archive import StoredTurn
from dashcalib_ros.reconstruction.scene import Scene, errors_px
from dashcalib_ros.turns.turn import Turn

PACKAGES = ('dashcalib_ros', 'numpy', 'scipy', 'opencv-python-headless', 'pycolmap', 'pyceres')


@dataclass(frozen=True)
class Evidence:
    """What the drive has shown, beside the solution.

    image_size: of the input; shrink: by what factor the images were made smaller for all that is
    in a scene. built: scenes by their turn's centre, None where there is none. stored: the turns
    of earlier drives that were there to choose from.
    """

    image_size: tuple[int, int]
    frames: int
    turns: tuple[Turn, ...]
    built: dict[int, Scene | None]
    magnitudes: npt.NDArray[np.float64]
    mask: npt.NDArray[np.bool_] | None
    shrink: int
    timing: dict[str, float]
    warnings: tuple[str, ...] = ()
    stored: tuple[StoredTurn, ...] = ()


def conclude(solution: Solution | None, evidence: Evidence, config: Config) -> Calibration:
    """Return the calibration; a refused one has no intrinsics, so that nobody takes them."""
    verdict = judge(solution, config.verdict) if solution else _nothing(evidence)
    intrinsics = sigma = error = shutter = None
    details: dict[str, object] = {}
    warnings = evidence.warnings
    if solution is not None:
        details = _details(solution)
        if verdict.level != 'refused':
            intrinsics = _full_size(solution.camera.params, evidence.shrink, shift=True)
            sigma = _full_size(solution.sigma, evidence.shrink, shift=False)
            error = solution.reprojection_error_px * evidence.shrink
            warnings += _left_out(solution, evidence.shrink, config)
            if solution.readout_s:
                shutter = Shutter(1e3 * solution.readout_s, 1e3 * solution.readout_sigma_s)
    return Calibration(
        verdict=verdict, image_size=evidence.image_size, intrinsics=intrinsics, sigma=sigma,
        turns=tuple(_summary(turn, evidence, solution)
                    for turn in sorted(evidence.turns, key=lambda turn: turn.center)),
        frames=evidence.frames, reprojection_error_px=error, timing=evidence.timing,
        versions=_versions(), config=config, magnitudes=evidence.magnitudes, mask=evidence.mask,
        details=details, rolling_shutter=shutter, warnings=warnings,
        stored_turns=tuple(_stored_summary(turn, solution) for turn in evidence.stored))


def _left_out(solution: Solution, shrink: int, config: Config) -> tuple[str, ...]:
    """Return a warning where the lens is clearly not quite what the six parameters describe."""
    moves, (p1, p2, k3) = solution.freed[:4], solution.freed[6:]
    scale = np.repeat([solution.camera.fx, solution.camera.image_size[0]], 2)
    if not np.max(np.abs(moves) / scale) > config.verdict.told_model_error:
        return ()
    told = ', '.join(f'{name} by {shrink * move:+.1f}'
                     for name, move in zip(('fx', 'fy', 'cx', 'cy'), moves, strict=True))
    return (f'the lens seems to have p1 {p1:+.4f}, p2 {p2:+.4f} and k3 {k3:+.3f}, which are not '
            f'calibrated: they would move {told} px; sigma allows for that',)


def _nothing(evidence: Evidence) -> Verdict:
    """Return the verdict on a drive that gave no scene."""
    if evidence.frames < 2:
        return Verdict('refused', (f'there is only {evidence.frames} image: record a drive with '
                                   f'turns',))
    if not evidence.turns:
        return Verdict('refused', (
            'no turn was found: the car stood, drove straight on, or the pictures show too '
            'little; record a drive with turns, in daylight',))
    return Verdict('refused', (
        f'none of the {len(evidence.turns)} turns could be reconstructed: the pictures are too '
        f'dark or blurred, or the camera turned without moving',))


def _full_size(params: npt.NDArray[np.float64], factor: int, shift: bool) -> Intrinsics:
    """Return parameters (or sigmas: no shift) of the small image for the full one."""
    fx, fy, cx, cy, k1, k2 = (float(value) for value in params)
    offset = (factor - 1) / 2 if shift else 0.0
    return Intrinsics(fx * factor, fy * factor, cx * factor + offset, cy * factor + offset, k1, k2)


def _summary(turn: Turn, evidence: Evidence, solution: Solution | None) -> TurnSummary:
    used = {scene.center: scene for scene in solution.scenes} if solution else {}
    scene = used.get(turn.center) or evidence.built.get(turn.center)
    error = None
    if scene is not None:
        camera = solution.camera if solution and turn.center in used else scene.camera
        squares = errors_px(scene, camera)[scene.structure.used] ** 2
        error = float(np.sqrt(np.mean(squares))) * evidence.shrink
    return TurnSummary(
        center=turn.center, first=turn.first, last=turn.last, stamp_s=turn.stamp_s,
        prominence=turn.prominence, images=len(scene.tracks.frames) if scene else turn.images,
        registered=int(scene.structure.registered.sum()) if scene else 0,
        used=turn.center in used, yaw_deg=scene.yaw_deg if scene else None,
        reprojection_error_px=error,
        misfit=solution.misfits.get(turn.center) if solution else None)


def _stored_summary(turn: StoredTurn, solution: Solution | None) -> StoredTurnSummary:
    scene = turn.scene
    used = {each.center for each in solution.scenes} if solution else set()
    return StoredTurnSummary(scene.center, turn.stamp_s, turn.prominence, scene.yaw_deg,
                             len(scene.tracks.frames), scene.center in used,
                             solution.misfits.get(scene.center) if solution else None)


def _details(solution: Solution) -> dict[str, object]:
    width = solution.camera.image_size[0]
    return {
        'step1': {'f_over_width': solution.step1.fx / width, 'k1': solution.step1.k1,
                  'k2': solution.step1.k2},
        'focal_profile': {'f_over_width': solution.around.ratios.tolist(),
                          'cost_px2': solution.around.costs.tolist()},
        'profile_contrast': profile_contrast(solution),
        'turns_disagree_fx': focal_disagreement(solution),
        'left_out': dict(zip(('p1', 'p2', 'k3'), solution.freed[6:].tolist(), strict=True)),
        'correlation': (solution.covariance / np.outer(solution.sigma, solution.sigma)).tolist(),
    }


def _versions() -> dict[str, str]:
    versions = {'python': platform.python_version()}
    for name in PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = 'unknown'
    return versions
