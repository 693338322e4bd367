# SPDX-License-Identifier: Apache-2.0
"""What the page shows of the lens, of the evidence for it, and of how the camera is mounted."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import remainder

import numpy as np

from dashcalib_ros.arrays import Floats, Ints, Pixels
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.remap import WIDEST, rectified_matrix, rectify, seen_at
from dashcalib_ros.judge import CalibrationData
from dashcalib_ros.judge.agreement import focal_of_turns, sigma_by_count
from dashcalib_ros.judge.calibration import Material, Mount
from dashcalib_ros.reconstruct.scene import Profile, Scene, residuals_px
from dashcalib_ros.report.charts import (
    Axes,
    arrows,
    data_uri,
    line,
    log_ticks,
    magnification,
    mask_over,
    outline,
    picture,
    strokes,
    svg,
    text,
    ticks,
)
from dashcalib_ros.report.turns import focal_by_turn
from dashcalib_ros.report.wording import angle_text
from dashcalib_ros.solve.solution import Solution
from dashcalib_ros.solve.spread import SigmaMap

WIDTH = 440  # px of a plot
CELLS = 18  # columns of the maps of observations
FEWEST = 4  # observations of a cell whose mean residual is drawn
GRID_LINES = 12  # over the picture's width
# from little to much, BGR
RAMP = np.array([(250, 243, 236), (238, 205, 160), (206, 148, 78), (142, 86, 34), (72, 38, 16)])
BY_TURN = ('fx by each turn alone, with one sigma. Last, and as a band: all turns together, '
           'including how much they differ.')
# times the sigma of the best turn; where all together know less, that needs no explanation
MUCH_BETTER = 0.5
WHY_TOGETHER = (' One turn alone cannot separate fx from the other parameters of the lens; turns '
                'that differ can, so together they know fx far better than each alone.')


@dataclass(frozen=True)
class Drawing:
    """A drawing with its title, and a sentence about it."""

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


def uncertainty_of(c: CalibrationData) -> Drawing | None:
    """Return the uncertainty over the picture; None where it is not known."""
    if c.material is None or c.camera is None or c.material.solution is None:
        return None
    found = c.material.solution.sigma_map
    if c.sigma_px is None or not np.isfinite(found.sigma).all():
        return None
    return Drawing(
        'Uncertainty over the picture', sigma_svg(found, c.image_size, c.material.px),
        f'How many pixels this camera may be off, one sigma: {c.sigma_px.rms:.2f} px over the '
        f'picture (RMS), {c.sigma_px.worst:.2f} px at the worst place.')


def slider_of(c: CalibrationData) -> Slider | None:
    """Return the picture of the turn that shows most, of this drive, without distortion."""
    pictures = {} if c.material is None or c.material.solution is None else c.material.pictures
    turns = [turn for turn in c.turns if turn.id in pictures]
    if not turns or c.camera is None:
        return None
    best = max(turns, key=lambda turn: (turn.used, turn.prominence))
    image = pictures[best.id].image
    height, width = image.shape[:2]
    camera = c.camera.resized(width / c.image_size[0], (width, height))
    straight, bent_grid, straight_grid, moved = undistorted(image, camera, c.config.rectified)
    moved *= c.image_size[0] / width
    return Slider(data_uri(image), data_uri(straight), bent_grid, straight_grid, width,
                  height, f'The orange grid shows the same rays on both sides. The lens moves '
                          f'points by up to {moved:.0f} px.')


def evidence_of(c: CalibrationData, mask_id: str | None) -> list[Drawing]:
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
            best = material.px * min(turn.sigma for turn in focal_of_turns(solution).values())
            why = WHY_TOGETHER if c.sigma['fx'] < MUCH_BETTER * best else ''
            drawings.append(Drawing('fx by turn', by_turn, BY_TURN + why))
    camera = None if solution is None else solution.camera
    xy, residual = observations_of(scenes, camera)
    if len(xy):
        size = scenes[0].tracks.image_size
        drawings += [_residuals(xy, residual, size, material.px), _coverage(xy, size, mask_id)]
    return drawings


def _profile(c: CalibrationData, material: Material, scenes: list[Scene]) -> Drawing:
    solution, fx = material.solution, None if c.camera is None else c.camera.fx
    each = [scene.profile for scene in scenes]
    if solution is not None and c.camera is not None:
        # one kind of lens: the profiles of others mean something else
        family = c.camera.family
        own = [scene.starts[family].profile for scene in scenes if family in scene.starts]
        each = [profile for profile in own if len(profile.ratios)] or each
    width_px = c.image_size[0]
    ratios = np.concatenate([profile.ratios for profile in each])
    ends = float(ratios.min() * width_px), float(ratios.max() * width_px)
    if fx is not None:
        ends = min(ends[0], fx / 1.05), max(ends[1], fx * 1.05)
    highest = max(float(profile.costs.max(initial=0.0)) for profile in each)
    axes = Axes(WIDTH, 220, ends, (0.0, 1.08 * highest), log_x=True)

    def curves(profiles: Sequence[Profile], kind: str) -> str:
        return strokes((axes.places(profile.ratios * width_px, profile.costs)
                        for profile in profiles), kind)

    content = axes.frame('focal length, px', 'error left, px² per observation', log_ticks(*ends),
                         ticks(0.0, axes.y[1], 4)) + curves(each, 'one-turn')
    if solution is not None:
        content += curves([solution.coarse], 'all-turns')
    if fx is not None:
        x = float(axes.across(fx))
        content += line(x, axes.top, x, axes.height - axes.bottom, 'joint')
    return Drawing(
        'Focal profile', svg(WIDTH, axes.height, 'focal profile', content),
        'The error of each turn (thin) and of all together (thick) at fixed focal lengths. A '
        'clear minimum: the turns determine the focal length. A flat line: they do not.')


def _growth(c: CalibrationData, solution: Solution, px: float) -> list[Drawing]:
    assert c.camera is not None
    percent = [100 * sigma * px / c.camera.fx for sigma in sigma_by_count(solution)]
    if not np.isfinite(percent).all() or not percent:
        return []
    low, high = min(percent) / 1.5, max(percent) * 2
    count = len(percent)
    axes = Axes(WIDTH, 220, (0.5, count + 0.5), (low, high), log_y=True)
    where = axes.places(np.arange(1.0, count + 1), np.array(percent))
    content = axes.frame('turns', 'sigma of fx, %', list(range(1, count + 1)),
                         log_ticks(low, high))
    if count > 2:
        # one turn does not show how much turns differ
        content += strokes([where[1:]], 'all-turns')
    content += (strokes(where[:1, None], 'dot other') + strokes(where[1:, None], 'dot all')
                + ''.join(text(x, y - 9, f'{value:.2g}', 'mid strong halo')
                          for (x, y), value in zip(where, percent, strict=True)))
    return [Drawing('Uncertainty against number of turns',
                    svg(WIDTH, axes.height, 'sigma of fx over the number of turns', content),
                    'The most prominent turn first. One turn (grey) does not show how much turns '
                    'differ; two do, and more do so better. So sigma may rise at the second.')]


def _residuals(xy: Floats, residual: Floats, size: tuple[int, int], px: float) -> Drawing:
    """Return the residuals over the picture: each cell's root mean square and mean.

    size: (width, height) of the scenes' images. px: of the input, in one of theirs.
    """
    cell, (rows, columns) = _cells(xy, size)
    count = np.bincount(cell, minlength=rows * columns)
    squares, *sums = (np.bincount(cell, each, len(count))
                      for each in (np.sum(residual**2, axis=1), *residual.T))
    mean = np.stack(sums, 1) / np.maximum(count, 1)[:, None]
    rms = np.sqrt(squares / np.maximum(count, 1))
    enough = count >= FEWEST
    height = _height(size)
    top = float(np.quantile(rms[enough], 0.95)) if enough.any() else 1.0
    shown = np.where(enough, np.minimum(rms / max(top, 1e-12), 1.0) * 0.75, np.nan)
    row, column = np.divmod(np.flatnonzero(enough), columns)
    centres = np.column_stack([(column + 0.5) * WIDTH / columns, (row + 0.5) * height / rows])
    moves = mean[enough] * WIDTH / size[0]
    magnified = magnification(moves, 0.8 * WIDTH / CELLS)
    content = (_heat(shown.reshape(rows, columns), WIDTH, height)
               + arrows(centres, magnified * moves, 'arrow')
               + strokes(centres[:, None], 'arrow-foot'))
    half = np.median(np.linalg.norm(residual, axis=1)) * px
    return Drawing('Residuals over the picture',
                   svg(WIDTH, height, 'residuals over the picture', content, 'plot map'),
                   f'Half of the {len(residual):,} are below {half:.2f} px. Arrows: mean residual '
                   f'of a cell, magnified {magnified} times. Tint: how much residuals scatter '
                   'there. Where neighbouring arrows point the same way over a large part of the '
                   'picture, the lens model does not fit.')


def _coverage(xy: Floats, size: tuple[int, int], mask_id: str | None) -> Drawing:
    cell, shape = _cells(xy, size)
    count = np.bincount(cell, minlength=shape[0] * shape[1]).reshape(shape)
    height = _height(size)
    shown = np.sqrt(count.astype(np.float64) / max(int(count.max()), 1))
    content = (_heat(np.where(count > 0, shown, np.nan), WIDTH, height)
               + mask_over(mask_id, WIDTH, height))
    masked = '; the tinted part moves with the car and is not used' if mask_id else ''
    return Drawing('Coverage',
                   svg(WIDTH, height, 'observations over the picture', content, 'plot map'),
                   f'Where points were observed. {100 * float(np.mean(count == 0)):.0f} % of the '
                   f'picture has none{masked}.')


def sigma_svg(found: SigmaMap, size: tuple[int, int], px: float,
              label: str = 'uncertainty over the picture', over: str = '') -> str:
    """Return the uncertainty over the picture, numbers in px on it. px: of the input, in one.

    over: a drawing between the colours and the numbers.
    """
    import cv2
    columns, rows = (len(np.unique(found.pixels[:, n])) for n in (0, 1))
    table = np.full((rows, columns), np.nan)
    places = [np.unique(found.pixels[:, n], return_inverse=True)[1] for n in (0, 1)]
    table[places[1], places[0]] = found.sigma * px
    # a lens may see nothing in the corners
    filled = np.where(np.isfinite(table), table, np.nanmax(table)).astype(np.float32)
    smooth = np.asarray(cv2.resize(filled, None, fx=8, fy=8, interpolation=cv2.INTER_CUBIC),
                        np.float64)
    top = float(filled.max())
    height = _height(size)
    parts = [_heat(smooth / max(top, 1e-12), WIDTH, height), over]
    for v in (0.0, 0.5, 1.0):
        for u in (0.0, 0.25, 0.5, 0.75, 1.0):
            value = table[round(v * (rows - 1)), round(u * (columns - 1))]
            if np.isfinite(value):
                kind = 'mid on-dark' if value > 0.45 * top else 'mid on-light'
                # at the edges, a little inside
                parts.append(text(u * WIDTH + (0.5 - u) * 44, v * height + 4 + (0.5 - v) * 26,
                                  f'{value:.2g}', kind))
    return svg(WIDTH, height, label, ''.join(parts), 'plot map')


def observations_of(scenes: Sequence[Scene], camera: Camera | None) -> tuple[Floats, Floats]:
    """Return (n, 2) where points were observed and (n, 2) their residuals, px of the scenes."""
    seen, residuals = [np.zeros((0, 2))], [np.zeros((0, 2))]
    for scene in scenes:
        used = scene.structure.used
        seen.append(scene.tracks.xy[used])
        residuals.append(residuals_px(scene, camera or scene.camera)[used])
    xy, residual = np.concatenate(seen), np.concatenate(residuals)
    known = np.isfinite(residual).all(axis=1)
    return xy[known], residual[known]


def undistorted(image: Pixels, camera: Camera, rectified: str
                ) -> tuple[Pixels, str, str, float]:
    """Return an image without distortion, and a grid over it and over the original.

    camera: of images of this size. The grids are of the same rays: paths of an SVG in px, first
    the bent one of the original, then the straight one. Last comes how far the lens moves a
    point at most, px, within 75 degrees of its axis.
    """
    height, width = image.shape[:2]
    with np.errstate(all='ignore'):
        straight = rectify(image, camera, rectified)
        matrix = rectified_matrix(camera, rectified)
        step = width / GRID_LINES
        lines = []
        for x in np.arange(step / 2, width, step):
            lines.append(np.column_stack([np.full(60, x), np.linspace(0, height - 1, 60)]))
        for y in np.arange(step / 2, height, step):
            lines.append(np.column_stack([np.linspace(0, width - 1, 60), np.full(60, y)]))
        bent = [seen_at(each, matrix, camera) for each in lines]
        places = np.concatenate(lines)
        rays = camera.rays(places)
        plain = rays[:, :2] / rays[:, 2:] * camera.params[:2] + camera.params[2:4]
        moved = np.linalg.norm(plain - places, axis=1)[rays[:, 2] > np.cos(WIDEST)]
    most = float(moved.max(initial=0.0))
    seen = [xy[np.abs(xy).max(axis=1) < 1e5] for xy in bent]
    return (straight, outline(xy for xy in seen if len(xy) > 1),
            outline(each[[0, -1]] for each in lines), most)


def _heat(share: Floats, width: float, height: float) -> str:
    """Return values from 0 to 1 as colours, over width x height px; clear where NaN."""
    known = np.isfinite(share)
    at = np.clip(np.where(known, share, 0.0), 0.0, 1.0) * (len(RAMP) - 1)
    below = np.minimum(at.astype(int), len(RAMP) - 2)
    part = (at - below)[..., None]
    colour = RAMP[below] * (1 - part) + RAMP[below + 1] * part
    image = np.dstack([colour, np.where(known, 255, 0)]).round().astype(np.uint8)
    smooth = '' if share.shape[1] > 40 else ' style="image-rendering:pixelated"'
    return picture(data_uri(image, 'png'), width, height, smooth)


def _cells(xy: Floats, size: tuple[int, int]) -> tuple[Ints, tuple[int, int]]:
    """Return the cell of each pixel (n, 2), and how many (rows, columns) of them there are."""
    rows = max(1, round(CELLS * size[1] / size[0]))
    at = np.clip((xy + 0.5) / size * (CELLS, rows), 0, (CELLS - 1, rows - 1)).astype(int)
    return at[:, 1] * CELLS + at[:, 0], (rows, CELLS)


def _height(size: tuple[int, int]) -> float:
    return round(WIDTH * size[1] / size[0])


# small angles are drawn so many times as large
ENLARGED = 5.0
# a car of 440 x 160 px from the side, its camera, and from above; (x, y)
SIDE = np.array([(20, 120), (24, 92), (120, 84), (170, 48), (290, 46), (350, 84), (410, 94),
                 (420, 120), (20, 120)], float)
ABOVE = np.array([(20, 40), (30, 30), (400, 30), (424, 50), (424, 110), (400, 130), (30, 130),
                  (20, 120), (20, 40)], float)
CAMERA_SIDE, CAMERA_ABOVE = (292.0, 54.0), (300.0, 80.0)
HEIGHT, AXIS = 160, 130.0
# columns of arrows over the picture; they are drawn so that the longest is as long as a cell
ARROWS = 18


def mounting_of(c: CalibrationData) -> list[Drawing]:
    """Return the car from the side and from above, and the horizon in a picture."""
    if c.mount is None or c.camera is None:
        return []
    mount = c.mount
    left_deg = remainder(180 - mount.yaw_left_deg, 360) if mount.rear else mount.yaw_left_deg
    drawings = [
        Drawing('From the side',
                _car(SIDE, CAMERA_SIDE, mount, -mount.pitch_up_deg, 'from the side'),
                _angle('pitch_up_deg', mount)),
        Drawing('From above', _car(ABOVE, CAMERA_ABOVE, mount, -left_deg, 'from above'),
                _angle('yaw_left_deg', mount))]
    return [*drawings, _horizon(c, mount, c.camera)]


def _angle(name: str, mount: Mount) -> str:
    text = angle_text(name, getattr(mount, name), mount.sigma[name])
    return f'{text[0].upper()}{text[1:]}, drawn {ENLARGED:.0f} times as large.'


def field_of(c: CalibrationData) -> list[Drawing]:
    """Return the field as arrows over the picture; none where none is used."""
    if c.field is None or not c.field.used or c.camera is None:
        return []
    width, height = c.image_size
    cell = width / ARROWS
    across, down = np.meshgrid(np.arange(cell / 2, width, cell), np.arange(cell / 2, height, cell))
    pixels = np.column_stack([across.ravel(), down.ravel()])
    moves = c.field.field.displacement(pixels)
    longest = max(float(np.linalg.norm(moves, axis=1).max()), np.finfo(float).tiny)
    small = WIDTH / width
    drawn = arrows(pixels * small, moves * small * cell / longest, 'arrow')
    return [Drawing(
        'The field', svg(WIDTH, height * small, 'displacements over the picture', drawn, 'map'),
        f'What the lens model cannot describe, for example the bend of a windscreen: '
        f'{c.field.text} (RMS), {c.field.worst_px:.2f} px at the worst place. The longest arrow '
        f'is {longest:.2f} px.')]


def _car(side: Floats, camera: tuple[float, float], mount: Mount, down_deg: float, label: str
         ) -> str:
    """Return a car that drives to the right; down_deg: of the camera's axis, in the drawing."""
    angle, way = np.radians(ENLARGED * down_deg), -1 if mount.rear else 1
    dashed = 'where the car comes from' if mount.rear else 'direction of travel'
    end = np.array(camera) + AXIS * np.array([way * np.cos(angle), np.sin(angle)])
    return svg(WIDTH, HEIGHT, f'the car {label}', ''.join([
        strokes([side], 'camera'),
        line(*camera, camera[0] + way * AXIS, camera[1], 'unused'),
        line(*camera, float(end[0]), float(end[1]), 'all-turns'),
        strokes([np.array([camera])], 'dot all'),
        text(20, HEIGHT - 8, f'dashed: {dashed}')]))


def _horizon(c: CalibrationData, mount: Mount, camera: Camera) -> Drawing:
    """Return the horizon, and the pixel that the car travels to, in a picture of the drive."""
    width, height = c.image_size
    level = replace(mount, yaw_left_deg=0.0)
    angles = np.radians(np.linspace(-80.0, 80.0, 161))
    around = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))])
    seen = camera.project(around @ level.rotation)
    inside = np.isfinite(seen).all(axis=1) & (np.abs(seen - [width / 2, height / 2])
                                             < [width / 2, height / 2]).all(axis=1)
    small = WIDTH / width
    pictures = {} if c.material is None else c.material.pictures
    shown = next((pictures[turn.id].image for turn in c.turns if turn.id in pictures), None)
    below = '' if shown is None else picture(data_uri(shown), WIDTH, height * small)
    way = 'from which the car comes' if mount.rear else 'towards which the car travels'
    u, v = small * mount.travel_px[0], small * mount.travel_px[1]
    marks = (strokes([small * seen[inside]], 'ruler') + line(u - 9, v, u + 9, v, 'residual')
             + line(u, v - 9, u, v + 9, 'residual'))
    return Drawing('In the picture',
                   svg(WIDTH, height * small, 'horizon and point of travel', below + marks, 'map'),
                   f'The horizon of a flat road, and the pixel {way}: '
                   f'{mount.travel_px[0]:.1f}, {mount.travel_px[1]:.1f} ± '
                   f'{mount.travel_sigma_px:.1f} px.')
