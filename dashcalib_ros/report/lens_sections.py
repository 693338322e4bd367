"""The page's sections of the lens and of the evidence: drawings with their captions."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.judge import Calibration
from dashcalib_ros.judge.calibration import Material
from dashcalib_ros.judge.focal_by_turn import sigma_by_count
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.report.figures import jpeg_data_uri
from dashcalib_ros.report.lens_figures import (
    coverage_svg,
    growth_svg,
    observations_of,
    profile_svg,
    residual_svg,
    sigma_svg,
    undistorted,
)
from dashcalib_ros.report.turn_sections import focal_by_turn
from dashcalib_ros.solve.solution import Solution

BY_TURN = ('Each turn alone, one sigma. Last, and as a band: all together, with how much the '
           'turns differ.')


@dataclass(frozen=True)
class Drawing:
    """A drawing with its title, and what it tells."""

    title: str
    svg: str
    caption: str


@dataclass(frozen=True)
class Slider:
    """A picture as it is and without distortion, with the same grid. width, height: px."""

    original: str
    straight: str
    bent_grid: str
    straight_grid: str
    width: int
    height: int
    caption: str


@dataclass(frozen=True)
class Lens:
    """What there is to see of the lens."""

    sigma: Drawing | None
    slider: Slider | None


def lens_of(c: Calibration) -> Lens:
    """Return the uncertainty over the picture, and a picture without distortion."""
    material = c.material
    if material is None or c.camera is None or material.solution is None:
        return Lens(None, None)
    found = material.solution.sigma_map
    sigma = None
    if c.sigma_px is not None and np.isfinite(found.sigma).all():
        sigma = Drawing(
            'Uncertainty over the picture', sigma_svg(found, c.image_size, material.px),
            f'By how many pixels this camera may be off, one sigma: {c.sigma_px.rms:.2f} px over '
            f'the picture (RMS), {c.sigma_px.worst:.2f} px at the worst.')
    return Lens(sigma, _slider(c, material))


def _slider(c: Calibration, material: Material) -> Slider | None:
    """Return the picture of the turn that shows most, of this drive."""
    turns = [turn for turn in c.turns if turn.id in material.pictures]
    if not turns or c.camera is None:
        return None
    best = max(turns, key=lambda turn: (turn.used, turn.prominence))
    image = material.pictures[best.id].image
    height, width = image.shape[:2]
    camera = c.camera.resized(width / c.image_size[0], (width, height))
    straight, bent_grid, straight_grid, moved = undistorted(image, camera, c.config.rectified)
    moved *= c.image_size[0] / width
    caption = 'The orange grid is of the same rays on both sides. '
    caption += f'The lens moves points by up to {moved:.0f} px.'
    return Slider(jpeg_data_uri(image), jpeg_data_uri(straight), bent_grid, straight_grid, width,
                  height, caption)


def evidence_of(c: Calibration, mask_id: str | None) -> list[Drawing]:
    """Return the plots of the evidence; none where no turn was reconstructed."""
    material = c.material
    if material is None or not material.scenes:
        return []
    solution = material.solution
    scenes = list(material.scenes.values()) if solution is None else list(solution.scenes)
    drawings = [_profile(c, material, list(material.scenes.values()))]
    if solution is not None and c.camera is not None and c.sigma is not None:
        drawings += _growth(c, solution, material.px)
        if by_turn := focal_by_turn(c):
            drawings.append(Drawing('What each turn says of fx', by_turn, BY_TURN))
    camera = None if solution is None else solution.camera
    xy, residual = observations_of(scenes, camera)
    if len(xy):
        size = scenes[0].tracks.image_size
        drawings += [_residuals(xy, residual, size, material.px), _coverage(xy, size, mask_id)]
    return drawings


def _profile(c: Calibration, material: Material, scenes: list[Scene]) -> Drawing:
    solution, fx = material.solution, None if c.camera is None else c.camera.fx
    if solution is not None and c.camera is not None:
        # one kind of lens: the profiles of others mean something else
        family = c.camera.family
        each = [scene.starts[family].profile for scene in scenes if family in scene.starts]
    else:
        each = [scene.profile for scene in scenes]
    each = [profile for profile in each if len(profile.ratios)]
    if not each:
        each = [scene.profile for scene in scenes]
    total = None if solution is None else solution.coarse
    caption = ('Each turn (thin) and all together (thick) were explained with the focal length '
               'held fixed. A clear minimum means that the turns know it; a flat line means that '
               'they do not.')
    return Drawing('Focal profile', profile_svg(each, total, c.image_size[0], fx), caption)


def _growth(c: Calibration, solution: Solution, px: float) -> list[Drawing]:
    assert c.camera is not None
    percent = [100 * sigma * px / c.camera.fx for sigma in sigma_by_count(solution)]
    if not np.isfinite(percent).all() or not percent:
        return []
    return [Drawing('Uncertainty against number of turns', growth_svg(percent),
                    'The most prominent turn first. One turn (grey) does not show how much turns '
                    'differ; that comes in with the second, and few turns know it badly.')]


def _residuals(xy: Floats, residual: Floats, size: tuple[int, int], px: float) -> Drawing:
    drawn, magnified = residual_svg(xy, residual, size)
    half = np.median(np.linalg.norm(residual, axis=1)) * px
    return Drawing('Residuals over the picture', drawn,
                   f'Half of the {len(residual):,} are below {half:.2f} px. Arrows: mean residual '
                   f'of a cell, {magnified} times as long as it is; tint: how much residuals '
                   'scatter there. Arrows that point the same way over a large part of the '
                   'picture mean that the lens model does not fit there.')


def _coverage(xy: Floats, size: tuple[int, int], mask_id: str | None) -> Drawing:
    drawn, empty = coverage_svg(xy, size, mask_id)
    caption = f'Where points were observed. {100 * empty:.0f} % of the picture has none'
    return Drawing('Coverage', drawn, caption + (
        '; what is tinted moves with the car and is not used.' if mask_id else '.'))
