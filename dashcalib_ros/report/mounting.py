"""Drawings of how the camera sits on the car, and of the field that no lens model has."""
from __future__ import annotations

from dataclasses import replace

import numpy as np

from dashcalib_ros.camera import Camera
from dashcalib_ros.judge import Calibration
from dashcalib_ros.judge.calibration import Mount
from dashcalib_ros.report.charts import dots, jpeg_data_uri, line, polyline, segments, svg, text
from dashcalib_ros.report.lens import WIDTH, Drawing

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


def mounting_of(c: Calibration) -> list[Drawing]:
    """Return the car from the side and from above, and the horizon in a picture."""
    if c.mount is None or c.camera is None:
        return []
    mount, sigma = c.mount, c.mount.sigma
    drawings = [
        Drawing('From the side', _car(SIDE, CAMERA_SIDE, -mount.pitch_up_deg, 'from the side'),
                f'Pitch {mount.pitch_up_deg:+.2f} ± {sigma["pitch_up_deg"]:.2f}° upwards, drawn '
                f'{ENLARGED:.0f} times as large.'),
        Drawing('From above', _car(ABOVE, CAMERA_ABOVE, -mount.yaw_left_deg, 'from above'),
                f'Yaw {mount.yaw_left_deg:+.2f} ± {sigma["yaw_left_deg"]:.2f}° to the left, drawn '
                f'{ENLARGED:.0f} times as large.')]
    return [*drawings, _horizon(c, mount, c.camera)]


def field_of(c: Calibration) -> list[Drawing]:
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
    arrows = segments(pixels * small, moves * small * cell / longest, 'arrow')
    return [Drawing(
        'The field', svg(WIDTH, height * small, 'displacements over the picture', arrows, 'map'),
        f'What the lens model leaves over, as a windscreen does: {c.field.rms_px:.2f} px RMS, '
        f'{c.field.worst_px:.2f} px at the worst. The longest arrow is {longest:.2f} px.')]


def _car(outline: np.ndarray, camera: tuple[float, float], turned_deg: float, label: str) -> str:
    """Return a car that drives to the right; turned_deg: of the camera's axis, clockwise."""
    angle = np.radians(ENLARGED * turned_deg)
    end = np.array(camera) + AXIS * np.array([np.cos(angle), np.sin(angle)])
    return svg(WIDTH, HEIGHT, f'the car {label}', ''.join([
        polyline(outline, 'camera'),
        line(*camera, camera[0] + AXIS, camera[1], 'unused'),
        line(*camera, float(end[0]), float(end[1]), 'all-turns'),
        dots(np.array([camera]), 'dot all'),
        text(20, HEIGHT - 8, 'dashed: direction of travel')]))


def _horizon(c: Calibration, mount: Mount, camera: Camera) -> Drawing:
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
    below = '' if shown is None else (
        f'<image href="{jpeg_data_uri(shown)}" width="{WIDTH}" height="{height * small:g}" '
        f'preserveAspectRatio="none"/>')
    u, v = small * mount.travel_px[0], small * mount.travel_px[1]
    marks = ''.join([polyline(small * seen[inside], 'ruler') if inside.sum() > 1 else '',
                     line(u - 9, v, u + 9, v, 'residual'), line(u, v - 9, u, v + 9, 'residual')])
    return Drawing('In the picture',
                   svg(WIDTH, height * small, 'horizon and point of travel', below + marks, 'map'),
                   f'The horizon of a flat road, and the pixel towards which the car travels: '
                   f'{mount.travel_px[0]:.1f}, {mount.travel_px[1]:.1f} ± '
                   f'{mount.travel_sigma_px:.1f}.')
