# SPDX-License-Identifier: Apache-2.0
"""A rig for people: where each camera sits, and what moved since."""
from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera.rotation import OPTICAL
from dashcalib_ros.formats.values import Placed
from dashcalib_ros.report.charts import Axes, line, strokes, svg, text, ticks
from dashcalib_ros.report.lens import WIDTH, Drawing
from dashcalib_ros.report.page import template
from dashcalib_ros.rig.moved import RigChange
from dashcalib_ros.rig.placed import AXES, PlacedCamera, RigCalibration

# m: of a camera's axis, and around all of them; and by how much its sigmas are enlarged
AXIS_M, AROUND_M, ENLARGED = 0.8, 1.2, 10.0
HEIGHT = 320  # px of a drawing


def rig_html(rig: RigCalibration, cameras: Sequence[Placed]) -> str:
    """Return a page of a rig: the car from above and from the side, and what is known about it.

    cameras: those that have a place, the base first.
    """
    head = ('camera', 'verdict', *(f'rotation {axis}, °' for axis in AXES),
            *(f'translation {axis}, m' for axis in AXES), 'clock, ms')
    return template('compare.html').render(
        title='Cameras of one car', overlines=[f'against {rig.base}'],
        answers=[*witness_lines(rig), *(str(reason) for camera in rig.cameras.values()
                                        for reason in camera.reasons)],
        maps=[_drawn(rig, cameras, 1, 'From above', 'm to the left'),
              _drawn(rig, cameras, 2, 'From the side', 'm upwards')] if cameras else [],
        drawn='Where they sit', results='Degrees of freedom', head=head,
        rows=[(name, camera.verdict, *_cells(camera)) for name, camera in rig.cameras.items()],
        note='Rotations and translations go from the optical axes of the base to those of the '
             'camera (x to the right, y down, z ahead), with one sigma and a verdict each.')


def _drawn(rig: RigCalibration, cameras: Sequence[Placed], up: int, title: str, label: str
           ) -> Drawing:
    """Return the cameras as seen along an axis of the car; up: the one that goes upwards."""
    car = next((each.mount.rotation for each in cameras if each.mount), OPTICAL)[[0, up]]
    centres = np.array([car @ np.linalg.inv(each.pose)[:3, 3] for each in cameras])
    middle = (centres.min(axis=0) + centres.max(axis=0)) / 2
    half = float(np.ptp(centres, axis=0).max()) / 2 + AROUND_M
    across = half * (WIDTH - 66) / (HEIGHT - 64)
    axes = Axes(WIDTH, HEIGHT, (middle[0] - across, middle[0] + across),
                (middle[1] - half, middle[1] + half))
    angles = np.linspace(0.0, 2 * np.pi, 49)
    parts = [axes.frame('m ahead', label, ticks(*axes.x), ticks(*axes.y, 4))]
    for each, centre in zip(cameras, centres, strict=True):
        # from the camera's axes to the drawing
        turn, found = car @ each.rotation.T, rig.cameras[each.name]
        points = centre + AXIS_M * np.array([[0.0, 0.0], turn[:, 2]])
        (x, y), (tip_x, tip_y) = axes.places(*points.T).tolist()
        parts += [line(x, y, tip_x, tip_y, 'all-turns'), strokes([np.array([[x, y]])], 'dot all'),
                  text(x + 6, y - 6, each.name)]
        if found.translation_sigma_m is not None and each.translation_m is not None:
            parts.append(_ellipse(axes, centre, turn * found.translation_sigma_m, angles))
        if found.rotation_sigma_deg is not None:
            # the axis is moved by rotations about the camera's x and y
            tip = AXIS_M * turn[:, :2] * np.radians(found.rotation_sigma_deg)[[1, 0]]
            parts.append(_ellipse(axes, points[1], tip, angles))
    return Drawing(title, svg(WIDTH, HEIGHT, f'the cameras {title.lower()}', ''.join(parts)),
                   f'Lines: where each camera looks. Ellipses: one sigma of its place and of its '
                   f'axis, {ENLARGED:.0f} times as large as it is.'
                   + ('' if any(each.translation_m is not None for each in cameras[1:]) else
                      ' No metres are known: all are drawn at one place.'))


def _ellipse(axes: Axes, centre: Floats, sigmas: Floats, angles: Floats) -> str:
    """Return an ellipse of ENLARGED sigmas; sigmas: (2, n) of which each column is one."""
    values, vectors = np.linalg.eigh(sigmas @ sigmas.T)
    around = (vectors * np.sqrt(np.maximum(values, 0.0))) @ [np.cos(angles), np.sin(angles)]
    return strokes([axes.places(*(centre[:, None] + ENLARGED * around))], 'camera here')


def _cells(camera: PlacedCamera) -> list[str]:
    """Return each degree of freedom: its value, sigma and verdict."""
    clock = None if camera.time_offset_s is None else (1e3 * camera.time_offset_s,)
    sigma = None if camera.time_sigma_s is None else (1e3 * camera.time_sigma_s,)
    return [f'{value:.{digits}f} ± {each:.{digits}f}, {sight}' if known else sight
            for values, sigmas, sights, digits in (
                (camera.rotation_deg, camera.rotation_sigma_deg, camera.visible.rotation, 2),
                (camera.translation_m, camera.translation_sigma_m, camera.visible.translation, 3),
                (clock, sigma, (camera.visible.clock,), 1))
            for known in [values is not None and sigmas is not None]
            for value, each, sight in zip(values or [0.0] * len(sights),
                                          sigmas or [0.0] * len(sights), sights, strict=True)]


def witness_lines(rig: RigCalibration) -> list[str]:
    """Return what cameras that see the same say."""
    return [f'{a} and {b} see the same: {each.matches} matches, epipolar residual '
            f'{each.median:.2f} px, over the picture {each.cells_rms:.2f} px RMS'
            for (a, b), each in rig.witness.items()]


def rig_lines(cameras: Mapping[str, PlacedCamera]) -> list[str]:
    """Return a line for each camera: its verdict, its place, and the sigmas."""
    found = []
    for name, camera in cameras.items():
        text = f'{name}: {camera.verdict}'
        if camera.rotation_deg is not None and camera.rotation_sigma_deg is not None:
            text += f', rotation {_values(camera.rotation_deg, camera.rotation_sigma_deg, 2)}°'
        if camera.translation_m is not None and camera.translation_sigma_m is not None:
            text += (f', translation '
                     f'{_values(camera.translation_m, camera.translation_sigma_m, 3)} m')
        if camera.time_offset_s is not None and camera.time_sigma_s is not None:
            text += (f', clock {1e3 * camera.time_offset_s:.1f} ± '
                     f'{1e3 * camera.time_sigma_s:.1f} ms')
        found.append(text)
    return found


def change_lines(found: RigChange) -> list[str]:
    """Return the answer, and a line for each camera: whether and by how much it moved."""
    lines = [f'answer: {found.answer}']
    if found.exchanged:
        a, b = found.exchanged
        lines.append(f'{a} and {b} were exchanged: each sits where the other one sat')
    for name, move in found.cameras.items():
        text = f'{name}: ' + ('moved' if move.moved else 'it or the other one moved'
                              if move.perhaps else 'sits as before')
        text += f', rotation {_values(move.rotation_deg, move.rotation_sigma_deg, 2)}°'
        if move.translation_m is not None and move.translation_sigma_m is not None:
            text += f', translation {_values(move.translation_m, move.translation_sigma_m, 3)} m'
        lines.append(text)
    return lines + [f'{name}: its place is not known in both' for name in found.unknown]


def _values(values: tuple[float, ...], sigmas: tuple[float, ...], digits: int) -> str:
    return '(' + ', '.join(f'{value:.{digits}f} ± {sigma:.{digits}f}' for value, sigma in zip(
        values, sigmas, strict=True)) + ')'
