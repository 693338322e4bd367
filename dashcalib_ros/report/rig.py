# SPDX-License-Identifier: Apache-2.0
"""A rig for people: where each camera sits, and what moved since."""
from __future__ import annotations

from collections.abc import Mapping

from dashcalib_ros.rig.moved import RigChange
from dashcalib_ros.rig.placed import PlacedCamera


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
