"""What is drawn of one turn: its picture with tracks and residuals, and its path from above."""
from __future__ import annotations

import math

import numpy as np

from dashcalib_ros.arrays import Floats, Mask
from dashcalib_ros.camera import Camera
from dashcalib_ros.reconstruction.picture import TurnPicture
from dashcalib_ros.reconstruction.scene import Scene, residuals_px
from dashcalib_ros.report.charts import dots, line, polyline, segments, svg, text
from dashcalib_ros.report.figures import jpeg_data_uri

# keyframes before and after the picture whose observations are drawn as a track
TRAIL = 4
# px of the drawing; a residual that only one of ten exceeds is drawn about so long
ARROW = 9.0
MAGNIFICATIONS = (1, 2, 5, 10, 20, 50, 100)
# px; of the view from above
ABOVE = (440, 260)
# at the most, of points drawn
POINTS = 1500


def picture_svg(picture: TurnPicture, scene: Scene | None, camera: Camera | None,
                mask_id: str | None) -> tuple[str, int]:
    """Return a turn's picture with its tracks and residuals, and how much these are magnified.

    camera: of the scene's images. mask_id: of an element of the page that is the mask.
    """
    height, width = picture.image.shape
    parts = [f'<image href="{jpeg_data_uri(picture.image)}" width="{width}" height="{height}"/>']
    if mask_id is not None:
        parts.append(f'<svg width="{width}" height="{height}" viewBox="0 0 100 100" '
                     f'preserveAspectRatio="none"><use href="#{mask_id}"/></svg>')
    magnified = 0
    if scene is not None:
        drawn, magnified = _observations(picture, scene, camera or scene.camera)
        parts.append(drawn)
    return svg(width, height, 'a picture of the turn', ''.join(parts), 'picture'), magnified


def _observations(picture: TurnPicture, scene: Scene, camera: Camera) -> tuple[str, int]:
    [at] = np.flatnonzero(scene.tracks.frames == picture.frame)[:1] or [0]
    px = picture.image.shape[1] / scene.tracks.image_size[0]
    xy = (scene.tracks.xy + 0.5) * px - 0.5
    used = scene.structure.used
    trails = [xy[max(at - TRAIL, 0):at + TRAIL + 1, n][used[max(at - TRAIL, 0):at + TRAIL + 1, n]]
              for n in np.flatnonzero(used[at])]
    here = xy[at, used[at]]
    residual = residuals_px(scene, camera)[at, used[at]] * px
    residual = np.where(np.isfinite(residual), residual, 0.0)
    long = float(np.quantile(np.linalg.norm(residual, axis=1), 0.9)) if len(residual) else 0.0
    magnified = max((m for m in MAGNIFICATIONS if m * long <= ARROW), default=1)
    return (_trails(trails) + dots(here, 'seen')
            + segments(here, magnified * residual, 'residual')), magnified


def _trails(trails: list[Floats]) -> str:
    """Return one path through all tracks (n, 2)."""
    parts = []
    for xy in trails:
        if len(xy) < 2:
            continue
        steps = np.diff(np.round(xy, 1), axis=0)
        parts.append(f'M{xy[0, 0]:.1f} {xy[0, 1]:.1f}l'
                     + ' '.join(f'{dx:.1f} {dy:.1f}' for dx, dy in steps))
    return f'<path class="track" d="{"".join(parts)}"/>'


def above_svg(scene: Scene, frame: int | None = None) -> str:
    """Return the turn's path and points from above; up is where the car went first.

    frame: of the picture that is shown; its place is marked. '' where no path is known.
    """
    structure = scene.structure
    registered = structure.registered
    if registered.sum() < 2:
        return ''
    rotations = structure.rotations[registered]
    centres = -np.einsum('kji,kj->ki', rotations, structure.translations[registered])
    right, ahead = _ground(rotations)
    path = np.column_stack([centres @ right, centres @ ahead])
    points = structure.points[structure.used.any(axis=0)]
    points = np.column_stack([points @ right, points @ ahead])[:POINTS]
    reach = 2.0 * max(float(np.ptp(path, axis=0).max()), 1e-9)
    low, high = path.min(axis=0) - reach, path.max(axis=0) + reach
    points = points[_inside(points, low, high)]
    if len(points):
        # as much as there is to see around the path
        low = np.minimum(path.min(axis=0), np.quantile(points, 0.04, axis=0))
        high = np.maximum(path.max(axis=0), np.quantile(points, 0.96, axis=0))
        points = points[_inside(points, low, high)]
    width, height = ABOVE
    margin = 14
    scale = float(((np.array(ABOVE) - 2 * margin) / np.maximum(high - low, 1e-9)).min())

    def placed(xy: Floats) -> Floats:
        off = (xy - (low + high) / 2) * scale
        return np.asarray(np.column_stack([width / 2 + off[:, 0], height / 2 - off[:, 1]]))

    drawn = dots(placed(points), 'point') + polyline(placed(path), 'path')
    drawn += dots(placed(path), 'stop') + dots(placed(path)[:1], 'start')
    at = np.flatnonzero(scene.tracks.frames[registered] == frame)
    if len(at):
        drawn += dots(placed(path)[at], 'here')
    return svg(width, height, 'path and points from above', drawn, 'above')


def _ground(rotations: Floats) -> tuple[Floats, Floats]:
    """Return the directions to the right and ahead, of the first camera, on the ground (3,)."""
    down = rotations[:, 1].mean(axis=0)
    down /= np.linalg.norm(down)
    ahead = rotations[0, 2] - (rotations[0, 2] @ down) * down
    ahead /= np.linalg.norm(ahead)
    return np.cross(down, ahead), ahead


def _inside(points: Floats, low: Floats, high: Floats) -> Mask:
    return np.asarray(((points >= low) & (points <= high)).all(axis=1))


def direction(scene: Scene) -> str:
    """Return where the turn goes: 'to the right', 'to the left', or 'one way and back'."""
    yaws = scene.yaws_deg
    net = float(yaws[-1] - yaws[0])
    if abs(net) < 0.5 * scene.yaw_deg:
        return 'one way and back'
    return 'to the right' if net > 0 else 'to the left'


def estimates_svg(rows: list[tuple[str, float, float]], own: int | None, joint: tuple[
        float, float]) -> str:
    """Return what each turn says of fx, beside the result of all.

    rows: a name, fx and its sigma, px. own: the row that stands out. joint: fx and its sigma.
    """
    width, row, left, right, top = 440, 21, 62, 122, 8
    reach = 4 * joint[1]
    for _, fx, sigma in rows:
        # a turn that knows next to nothing must not make the others small
        if sigma < 8 * joint[1]:
            reach = max(reach, abs(fx - joint[0]) + 1.1 * sigma)
    height = top + row * (len(rows) + 1) + 28

    def across(fx: float) -> float:
        share = (fx - joint[0]) / (2 * reach) + 0.5
        return left + min(max(share, 0.0), 1.0) * (width - left - right)

    bottom = height - 26
    parts = [f'<rect class="band" x="{across(joint[0] - joint[1]):.1f}" y="{top}" '
             f'width="{across(joint[0] + joint[1]) - across(joint[0] - joint[1]):.1f}" '
             f'height="{bottom - top}"/>',
             line(across(joint[0]), top, across(joint[0]), bottom, 'joint'),
             line(left, bottom, width - right, bottom, 'grid')]
    for n, (name, fx, sigma) in enumerate([*rows, ('all', *joint)]):
        y = top + row * (n + 0.5)
        kind = 'all' if n == len(rows) else 'own' if n == own else 'other'
        beyond = abs(fx - joint[0]) > reach
        parts.append(line(across(fx - sigma), y, across(fx + sigma), y, f'bar {kind}'))
        if not beyond:
            parts.append(dots(np.array([[across(fx), y]]), f'dot {kind}'))
        parts.append(text(left - 8, y + 4, name, f'end {kind}-text'))
        parts.append(text(width, y + 4, with_sigma(fx, sigma), f'end {kind}-text'))
    digits = max(0, math.ceil(-math.log10(reach / 10)))
    for fx, kind in ((joint[0] - reach, ''), (joint[0], 'mid'), (joint[0] + reach, 'end')):
        parts.append(text(across(fx), bottom + 17, f'{fx:.{digits}f}', kind))
    return svg(width, height, 'fx by turn', ''.join(parts))


def with_sigma(fx: float, sigma: float) -> str:
    """Return a length in px with its sigma, with as many digits as this allows."""
    digits = 2 if sigma < 1 else 1 if sigma < 10 else 0
    return f'{fx:.{digits}f} ± {sigma:.{digits}f} px'
