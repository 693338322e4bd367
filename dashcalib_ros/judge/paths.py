"""The turns' paths as files: TUM's format, which evo reads, and a plot."""
from __future__ import annotations

from html import escape

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.judge.odometry import Odometry, Path, TurnOdometry

TRUE = 'poses'
# px of a turn's panel, and its margin
PANEL, MARGIN = 320, 28
COLUMNS = 3
COLOURS = ('#d62728', '#1f77b4', '#7f7f7f', '#2ca02c', '#9467bd')


def path_files(found: Odometry) -> dict[str, str]:
    """Return texts by the names of their files: paths.svg, and for each turn and camera a .tum.

    TURN_poses.tum has the true path with the camera's orientation, so that evo can compare the
    others with it: evo_rpe tum turn_000094_poses.tum turn_000094_ours.tum --align --correct_scale
    """
    texts = {'paths.svg': paths_svg(found)}
    mounted = mounting(found)
    for turn in found.turns:
        true = Path(turn.true.rotations @ mounted, turn.true.positions)
        for name, path in {TRUE: true, **turn.paths}.items():
            texts[f'turn_{turn.turn.number:06}_{name}.tum'] = _tum(turn, path)
    return texts


def mounting(found: Odometry) -> Floats:
    """Return (3, 3) the rotation from the camera to the frame of the poses (hand-eye).

    From the turns' rotations as the second camera has them, which is the drive's own.
    """
    from scipy.spatial.transform import Rotation
    name = found.names[min(1, len(found.names) - 1)]
    true, seen = (np.concatenate([_since_first(path) for path in paths]) for paths in (
        [turn.true for turn in found.turns], [turn.paths[name] for turn in found.turns]))
    rotation, _ = Rotation.align_vectors(true, seen)
    return np.asarray(rotation.as_matrix())


def _since_first(path: Path) -> Floats:
    """Return (k - 1, 3) the rotation vectors since the first keyframe."""
    from scipy.spatial.transform import Rotation
    return np.asarray(Rotation.from_matrix(
        path.rotations[0].T @ path.rotations[1:]).as_rotvec())


def _tum(turn: TurnOdometry, path: Path) -> str:
    from scipy.spatial.transform import Rotation
    quaternions = Rotation.from_matrix(path.rotations).as_quat()
    lines = []
    for stamp_ns, place, quaternion in zip(turn.stamps_ns.tolist(), path.positions, quaternions,
                                           strict=True):
        # as text: a float has too few digits for nanoseconds since 1970
        stamp = f'{stamp_ns // 10**9}.{stamp_ns % 10**9:09}'
        lines.append(' '.join([stamp, *(f'{value:.9f}' for value in (*place, *quaternion))]))
    return '\n'.join(lines) + '\n'


def paths_svg(found: Odometry) -> str:
    """Return a plot of each turn from above: the true path, and each camera's, fitted to it."""
    rows = -(-len(found.turns) // COLUMNS)
    columns = min(COLUMNS, len(found.turns))
    panels = ''.join(_panel(turn, found.names, n % COLUMNS * PANEL, n // COLUMNS * PANEL)
                     for n, turn in enumerate(found.turns))
    names = [('black', TRUE), *zip(COLOURS, found.names, strict=False)]
    legend = ''.join(
        f'<text x="{MARGIN + 150 * n}" y="{rows * PANEL + 18}" fill="{colour}">{escape(name)}'
        f'</text>' for n, (colour, name) in enumerate(names))
    width = max(columns * PANEL, MARGIN + 150 * len(names))
    return (f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {rows * PANEL + 28}" '
            f'font-family="sans-serif" font-size="13"><rect width="100%" height="100%" '
            f'fill="white"/>{panels}{legend}</svg>\n')


def _panel(turn: TurnOdometry, names: tuple[str, ...], left: int, top: int) -> str:
    true = turn.true.positions
    middle = true.mean(axis=0)
    # the ground is the plane in which the path extends most
    ground = np.linalg.svd(true - middle, full_matrices=False)[2][:2]
    flat = [(true - middle) @ ground.T, *(
        (_fitted(turn.paths[name].positions, true) - middle) @ ground.T for name in names)]
    extent = max(float(np.ptp(flat[0], axis=0).max()), 1e-9)
    scale = (PANEL - 2 * MARGIN) / extent
    centre = (flat[0].max(axis=0) + flat[0].min(axis=0)) / 2
    lines = ''.join(
        f'<polyline fill="none" stroke="{colour}" stroke-width="{width}" points="'
        + ' '.join(f'{left + PANEL / 2 + scale * (x - centre[0]):.1f},'
                   f'{top + PANEL / 2 + scale * (y - centre[1]):.1f}' for x, y in path) + '"/>'
        for colour, width, path in zip(('black', *COLOURS), (3, *[1.5] * len(names)), flat,
                                       strict=False))
    missed = ', '.join(f'{name} {turn.rotation_deg(name):.2f}°' for name in names)
    return (f'<text x="{left + 8}" y="{top + 16}">frame {turn.turn.number}: '
            f'{turn.angle_deg:.0f}°, {turn.length_m:.0f} m; missed by</text>'
            f'<text x="{left + 8}" y="{top + 32}">{escape(missed)}</text>{lines}')


def _fitted(path: Floats, true: Floats) -> Floats:
    """Return the path (k, 3) scaled, turned and moved onto the true one (Umeyama)."""
    own, other = path - path.mean(axis=0), true - true.mean(axis=0)
    u, values, v = np.linalg.svd(other.T @ own)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    scale = float((values * signs).sum() / max(float((own**2).sum()), 1e-12))
    return np.asarray(scale * own @ ((u * signs) @ v).T + true.mean(axis=0))
