# SPDX-License-Identifier: Apache-2.0
"""What the page shows of each turn: its tracks, a view in space, and its own fx."""
from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.camera import resized_pixels
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.errors import Notice, spared
from dashcalib_ros.judge import CalibrationData, TurnSummary
from dashcalib_ros.judge.agreement import focal_of_turns, leverages, turns_of_another_camera
from dashcalib_ros.judge.calibration import Material, StoredTurnSummary
from dashcalib_ros.reconstruct.scene import Scene, TurnPicture, residuals_px
from dashcalib_ros.report.charts import (
    Axes,
    arrows,
    data_uri,
    line,
    magnification,
    mask_over,
    picture,
    strokes,
    svg,
    text,
)
from dashcalib_ros.report.wording import optional, since_start

# where a turn goes
RIGHT, LEFT, BACK = 'to the right', 'to the left', 'one way and back'
# keyframes before and after the picture whose observations are drawn as a track
TRAIL = 4
# px of the drawing; a residual that only one of ten exceeds is drawn about so long
ARROW = 9.0
# px; of the view in space, its margin, and how long its cameras are
VIEW, MARGIN, CAMERA = (440, 270), 8, 13.0
# degrees, as in script.js; 90 is from above
TILT = 50.0
# at most, of points drawn
POINTS = 1500
# one stroke along all edges of a camera's pyramid, as wide as it is long
FRUSTUM = np.array([(0, 0, 0), (-.5, -.5, 1), (.5, -.5, 1), (0, 0, 0), (.5, .5, 1), (-.5, .5, 1),
                    (0, 0, 0), (-.5, -.5, 1), (-.5, .5, 1), (.5, .5, 1), (.5, -.5, 1)])

AnySummary = TurnSummary | StoredTurnSummary


@dataclass(frozen=True)
class TurnSection:
    """A turn as the page shows it; SVG texts are '' where there is nothing to draw.

    frame: of the picture; magnified: by how much its residuals are, 0 for none drawn. alone: its
    own fx, in words.
    """

    name: str
    facts: tuple[str, ...]
    used: bool
    unused_because: str | None
    picture: str
    frame: int | None
    magnified: int
    view: str
    alone: str


def turn_sections(c: CalibrationData, mask_id: str | None, lost: list[Notice]
                  ) -> list[TurnSection]:
    """Return a section for each turn of which there is anything to see; lost: as for spared()."""
    if c.material is None:
        return []
    alone, shares = _fx_alone(c), _shares(c)
    texts = {turn: _alone_text(fx, sigma, shares.get(turn, 0.0))
             for turn, (fx, sigma) in alone.items()}
    found = [spared(f'the drawing of turn {name}', lost, _section, turn, c, c.material,
                    texts.get(turn.id, ''), mask_id)
             for turn, name in zip(c.all_turns, names(c).values(), strict=True)]
    return [each for each in found if each and (each.picture or each.view)]


def _fx_alone(c: CalibrationData) -> dict[TurnId, tuple[float, float]]:
    """Return fx by each turn alone, and its sigma, px of the input.

    Nothing of a refused calibration, which has no numbers.
    """
    sigma = (c.sigma or {}).get('fx', math.nan)
    if c.camera is None or c.material is None or not 0 < sigma < math.inf:
        return {}
    solution = c.material.solution
    if solution is None:
        return {}
    alone = {turn: (found.fx * c.material.px, found.sigma * c.material.px)
             for turn, found in focal_of_turns(solution).items()}
    return alone if np.isfinite(list(alone.values())).all() else {}


def _shares(c: CalibrationData) -> dict[TurnId, float]:
    solution = c.material.solution if c.material and _fx_alone(c) else None
    return {} if solution is None else leverages(solution)


def spans_of(c: CalibrationData) -> list[tuple[float, float, float]]:
    """Return first and last stamp, s, of what counts of this drive, and its share."""
    shares, scenes = _shares(c), c.material.scenes if c.material else {}
    return [(*(scenes[turn].tracks.stamps_ns[[0, -1]] / 1e9).tolist(), share)
            for turn, share in sorted(shares.items()) if turn.of_this_drive and turn in scenes]


def names(c: CalibrationData) -> dict[TurnId, str]:
    """Return the turns' short names: numbers in the order of time, s1, s2 for stored ones."""
    own = {turn.id: str(n) for n, turn in enumerate(c.turns, 1)}
    # a fleet's clips are not earlier drives
    return own | {turn.id: f'{"" if turn.clip else "s"}{n}'
                  for n, turn in enumerate(c.stored_turns, 1)}


def _section(turn: AnySummary, c: CalibrationData, material: Material,
             alone: str, mask_id: str | None) -> TurnSection:
    scene, shown = material.scenes.get(turn.id), material.pictures.get(turn.id)
    camera = material.solution.camera if turn.used and material.solution is not None else None
    drawn, magnified = ('', 0) if shown is None else picture_svg(shown, scene, camera, mask_id)
    kind = 'Stored turn' if isinstance(turn, StoredTurnSummary) and not turn.clip else 'Turn'
    frame = None if shown is None else shown.frame
    return TurnSection(
        f'{kind} {names(c)[turn.id]}', _facts(turn, scene, c), turn.used, turn.unused_because,
        drawn, frame, magnified, '' if scene is None else view_svg(scene, frame), alone)


def _facts(turn: AnySummary, scene: Scene | None, c: CalibrationData) -> tuple[str, ...]:
    facts = [f'of {turn.clip or "an earlier drive"}' if isinstance(turn, StoredTurnSummary)
             else f'at {since_start(turn, c)} s, frames {turn.first} to {turn.last}']
    if turn.yaw_deg is not None:
        way = '' if scene is None else ' ' + direction(scene)
        facts.append(f'{turn.yaw_deg:.0f}°{way}')
    if turns_of_another_camera({turn.id: turn.misfit or 0.0}):
        facts.append(f'fits another camera: {turn.misfit:.1f} times the error of its own')
    return tuple(facts)


def _alone_text(fx: float, sigma: float, share: float) -> str:
    percent = min(max(100 * share, 0.0), 100.0)
    part = f'{percent:.0f}' if percent >= 1 else 'less than 1'
    return f'Alone: fx {with_sigma(fx, sigma)}, {part} % of the information about fx.'


def turn_rows(c: CalibrationData) -> list[dict[str, str]]:
    """Return the table of all turns: when, what each gave, and why it is unused."""
    short, shares = names(c), _shares(c)
    apart = {each.turn: f'{each.px:.3g} px, {each.sigmas:.1f} sigmas' for each in c.held_out}
    rows = []
    for turn in c.all_turns:
        row = {'turn': short[turn.id], 'at': getattr(turn, 'clip', '') or 'earlier', 'frames': '-',
               'yaw': optional(turn.yaw_deg, 0, '°'), 'keyframes': str(turn.images),
               'error': optional(turn.reprojection_error_px, 2, ' px'),
               'of fx': f'{100 * shares[turn.id]:.0f} %' if turn.id in shares else '-',
               'held out': apart.get(turn.id, '-'),
               'used': 'used' if turn.used else f'no: {turn.unused_because or "not needed"}'}
        if isinstance(turn, TurnSummary):
            row |= {'at': f'{since_start(turn, c)} s', 'frames': f'{turn.first} to {turn.last}',
                    'keyframes': f'{turn.registered} of {turn.images}' if turn.registered else '-'}
        rows.append(row)
    return rows


def picture_svg(shown: TurnPicture, scene: Scene | None, camera: Camera | None,
                mask_id: str | None) -> tuple[str, int]:
    """Return a turn's picture with its tracks and residuals, and how much these are magnified.

    camera: of the scene's images. mask_id: of an element of the page that is the mask.
    """
    height, width = shown.image.shape[:2]
    drawn = picture(data_uri(shown.image), width, height) + mask_over(mask_id, width, height)
    magnified = 0
    at = -1 if scene is None else int(np.searchsorted(scene.tracks.frames, shown.frame))
    # no tracks are known about a picture that is not a keyframe of the turn
    if scene is not None and shown.frame in scene.tracks.frames:
        px = width / scene.tracks.image_size[0]
        xy = resized_pixels(scene.tracks.xy, px)
        used = scene.structure.used
        near = slice(max(at - TRAIL, 0), at + TRAIL + 1)
        here = xy[at, used[at]]
        residual = np.nan_to_num(
            residuals_px(scene, camera or scene.camera)[at, used[at]] * px, posinf=0, neginf=0)
        magnified = magnification(residual, ARROW)
        drawn += (strokes((xy[near, n][used[near, n]] for n in np.flatnonzero(used[at])), 'track')
                  + strokes(here[:, None], 'seen')
                  + arrows(here, magnified * residual, 'residual'))
    return svg(width, height, 'a picture of the turn', drawn, 'picture'), magnified


def view_svg(scene: Scene, frame: int | None = None) -> str:
    """Return the turn's path, cameras and points, seen from behind and above where it began.

    The page's script turns it: each part has its points in space, from the middle of the drawing,
    px. frame: of the picture that is shown; its camera stands out. '' where no path is known.
    """
    structure, registered = scene.structure, scene.structure.registered
    if registered.sum() < 2:
        return ''
    rotations, centres = structure.path()
    axes = _axes(rotations)
    path = centres @ axes
    points = structure.points[structure.used.any(axis=0)] @ axes
    reach = 2.0 * max(float(np.ptp(path[:, :2], axis=0).max()), 1e-9)
    near = (points >= path.min(axis=0) - reach) & (points <= path.max(axis=0) + reach)
    points = points[near.all(axis=1)][:POINTS]
    # all of the path is seen, and most of the points
    most = np.quantile(points, (0.12, 0.88), axis=0) if len(points) else path
    low, high = np.minimum(path, most[0]).min(axis=0), np.maximum(path, most[-1]).max(axis=0)
    corners = np.stack(np.meshgrid(*np.stack([low, high], 1)), -1).reshape(-1, 3)
    spread = np.ptp(_seen(corners), axis=0)
    scale = float(((np.array(VIEW) - 2 * MARGIN) / np.maximum(spread, 1e-9)).min())
    width, height = scene.tracks.image_size
    frustum = CAMERA / scale * (FRUSTUM * (1, height / width, 1))
    cameras = np.einsum('nj,kji->kni', frustum, rotations) + centres[:, None]
    here = scene.tracks.frames[registered] == frame

    def part(xyz: Floats, kind: str) -> str:
        """Return a path of strokes (n, points of each, 3)."""
        placed = (xyz - (low + high) / 2) * scale
        flat = ' '.join(f'{value:.1f}' for value in placed.ravel())
        return strokes(np.array(VIEW) / 2 + _seen(placed), kind,
                       f' data-run="{xyz.shape[1]}" data-xyz="{flat}"')

    drawn = (part(points[:, None], 'point') + part(path[None], 'path')
             + part(cameras @ axes, 'camera') + part(path[:1, None], 'start'))
    if here.any():
        drawn += part(cameras[here] @ axes, 'camera here')
    return svg(*VIEW, 'path, cameras and points', drawn, 'space')


def _seen(xyz: Floats) -> Floats:
    """Return where points (..., 3), to the right, ahead and up, are seen (..., 2), in an SVG."""
    tilt = math.radians(TILT)
    return np.asarray(np.stack([xyz[..., 0], -math.sin(tilt) * xyz[..., 1]
                                - math.cos(tilt) * xyz[..., 2]], -1))


def _axes(rotations: Floats) -> Floats:
    """Return the directions to the right, ahead and up, of the first camera: columns (3, 3)."""
    down = rotations[:, 1].mean(axis=0)
    down /= np.linalg.norm(down)
    ahead = rotations[0, 2] - (rotations[0, 2] @ down) * down
    ahead /= np.linalg.norm(ahead)
    return np.column_stack([np.cross(down, ahead), ahead, -down])


def direction(scene: Scene) -> str:
    """Return where the turn goes: RIGHT, LEFT or BACK."""
    if abs(scene.right_deg) < 0.5 * scene.yaw_deg:
        return BACK
    return RIGHT if scene.right_deg > 0 else LEFT


def focal_by_turn(c: CalibrationData) -> str:
    """Return a plot of fx by each turn, beside that of all; '' where there is nothing."""
    alone = _fx_alone(c)
    if not alone or c.camera is None or c.sigma is None:
        return ''
    rows = [(f'turn {name}', *alone[turn]) for turn, name in names(c).items() if turn in alone]
    joint = c.camera.fx, c.sigma['fx']
    row, right, top = 21, 122, 8
    reach = 4 * joint[1]
    for _, fx, sigma in rows:
        # a turn that knows next to nothing must not make the others small
        if sigma < 8 * joint[1]:
            reach = max(reach, abs(fx - joint[0]) + 1.1 * sigma)
    ends = joint[0] - reach, joint[0] + reach
    axes = Axes(440, top + row * (len(rows) + 1) + 28, ends, (0.0, 1.0), 62, right, top, 26)
    bottom = axes.height - axes.bottom

    def across(fx: float) -> float:
        return float(axes.across(min(max(fx, ends[0]), ends[1])))

    low, high = (across(joint[0] + each) for each in (-joint[1], joint[1]))
    parts = [f'<rect class="band" x="{low:.1f}" y="{top}" width="{high - low:.1f}" '
             f'height="{bottom - top}"/>',
             line(across(joint[0]), top, across(joint[0]), bottom, 'joint'),
             line(axes.left, bottom, axes.width - right, bottom, 'grid')]
    for n, (name, fx, sigma) in enumerate([*rows, ('all', *joint)]):
        y = top + row * (n + 0.5)
        kind = 'all' if n == len(rows) else 'other'
        parts.append(line(across(fx - sigma), y, across(fx + sigma), y, f'bar {kind}'))
        if ends[0] <= fx <= ends[1]:
            parts.append(strokes([np.array([[across(fx), y]])], f'dot {kind}'))
        parts.append(text(axes.left - 8, y + 4, name, f'end {kind}-text'))
        parts.append(text(axes.width, y + 4, with_sigma(fx, sigma), f'end {kind}-text'))
    digits = max(0, math.ceil(-math.log10(reach / 10)))
    for fx, kind in ((ends[0], ''), (joint[0], 'mid'), (ends[1], 'end')):
        parts.append(text(across(fx), bottom + 17, f'{fx:.{digits}f}', kind))
    return svg(axes.width, axes.height, 'fx by turn', ''.join(parts))


def with_sigma(fx: float, sigma: float) -> str:
    """Return a length in px with its sigma, with as many digits as this allows."""
    digits = 2 if sigma < 1 else 1 if sigma < 10 else 0
    return f'{fx:.{digits}f} ± {sigma:.{digits}f} px'
