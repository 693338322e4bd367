# SPDX-License-Identifier: Apache-2.0
"""Whether a camera that was read can be one: the same checks for all formats.

What no camera has is an InputError; what few have is a warning. The units come first, then the
size of the pictures, as both spoil what the distortion does.
"""
from __future__ import annotations

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.errors import InputError, Notice
from dashcalib_ros.input.source import size_text
from dashcalib_ros.judge.check import MOST_PARTS, export_command, same_shape
from dashcalib_ros.limits import LENS_NUMBER

# of the picture, by which its middle is off: less than the first where a size fits, and more than
# the second where it does not
FITS, EXCHANGED, AS_GIVEN = 0.03, 0.06, 0.1
# of the width: of a shorter focal length no lens shows as much, and a longer one is rare (11
# degrees across)
SHORTEST, LONGEST = 0.1, 5.0
# |fy / fx - 1| of pixels that are not square, as cameras have 1 %; and how many times as long as
# wide no pixel is
ASPECT, LONGEST_PIXEL = 0.05, 3.0
# of the picture; a circular fisheye leaves 0.6 of a wide one black
MOST_UNSEEN = 2 / 3
# of the angle that a lens without distortion would see: a pincushion has more than the first, and
# nothing less than the second
FEW_ANGLES, LEAST_ANGLES = 0.8, 0.5
# of pictures as cameras take them, px
SIZES = ((320, 240), (640, 360), (640, 480), (672, 376), (752, 480), (800, 600), (848, 480),
         (960, 540), (1024, 768), (1242, 375), (1280, 720), (1280, 800), (1280, 960), (1280, 1024),
         (1440, 1080), (1600, 900), (1600, 1200), (1920, 1080), (1920, 1200), (1936, 1216),
         (2048, 1536), (2208, 1242), (2560, 1440), (2592, 1944), (2704, 1520), (3840, 2160),
         (4000, 3000))
# columns and rows of cells that share the picture
FINE = (100, 60)
# of width over height, where nothing but the centre says the size
SHAPES = (0.5, 2.5)


def check_lens(camera: Camera, path: object) -> None:
    """Raise InputError for numbers that no lens has: nothing can be computed with them."""
    check_focal(camera.fx, camera.fy, path)
    for name, value in camera.named.items():
        if abs(value) > LENS_NUMBER:
            raise InputError('E-CALIBRATION-LENS',
                             f'{path} has {name} = {value:.4g}, which no lens has; use a '
                             f'calibration in px')
    (width, height), centre = camera.image_size, (camera.cx, camera.cy)
    if camera.fx < SHORTEST * width and camera.fy < SHORTEST * height:
        shares = max(abs(value) for value in centre) <= 2
        remedy = (f'they are shares of the picture: multiply fx and cx by {width}, fy and cy by '
                f'{height}' if shares else 'write them in px, not in mm or shares of the picture')
        raise InputError('E-CALIBRATION-FOCAL',
                         f'{path} has fx = {camera.fx:.4g}, fy = {camera.fy:.4g}, too short for '
                         f'pictures of {size_text(camera.image_size)}; {remedy}')
    if max(camera.fy / camera.fx, camera.fx / camera.fy) > LONGEST_PIXEL:
        raise InputError('E-CALIBRATION-ASPECT', f'{_aspect_text(camera, path)}; correct it')
    if _off(camera, (height, width)) < EXCHANGED and _off(camera, camera.image_size) > AS_GIVEN:
        raise InputError('E-CALIBRATION-EXCHANGED',
                         f'{path} is for pictures of {width}x{height}, but the centre '
                         f'({camera.cx:.0f}, {camera.cy:.0f}) is that of {height}x{width}: are '
                         f'width and height exchanged, or cx and cy? write the width and cx first')
    (unseen, near), angles = _unseen(camera), _angles(camera)
    if unseen > MOST_UNSEEN or angles < LEAST_ANGLES:
        size = _size_doubt(camera, path)
        if size:
            raise InputError(size[0].code, str(size[0]))
        what = (f'the picture folds {near:.0f} px from its centre, and {100 * unseen:.0f} % of it '
                f'has no ray' if unseen > MOST_UNSEEN else
                f'it shows {100 * angles:.0f} % of the angle without')
        raise InputError('E-CALIBRATION-NO-RAY',
                         f'{path} has distortion that no lens has: with {_coefficients(camera)} '
                         f'{what}; check the order and the units of the coefficients')


def check_focal(fx: float, fy: float, path: object) -> None:
    """Raise InputError for the focal lengths of a camera that is not calibrated."""
    if not (fx > 0 and fy > 0):
        raise InputError('E-CALIBRATION-EMPTY',
                         f'{path} is uncalibrated: its focal length is not positive; calibrate '
                         f'the camera')


def doubts(camera: Camera, path: object) -> tuple[Notice, ...]:
    """Return what is odd in a camera that check_lens() lets pass, each with its remedy."""
    found, (width, _) = [], camera.image_size
    if abs(camera.fy / camera.fx - 1) > ASPECT:
        remedy = ('are fy and cx exchanged? the order is fx, fy, cx, cy'
                if abs(camera.cx / camera.fx - 1) < ASPECT else
                'correct it, unless the pictures are stretched')
        found.append(Notice('E-CALIBRATION-ASPECT', f'{_aspect_text(camera, path)}; {remedy}'))
    if camera.fx > LONGEST * width:
        across_deg = 2 * np.degrees(np.arctan(0.5 * width / camera.fx))
        found.append(Notice(
            'E-CALIBRATION-NARROW',
            f'{path}: fx = {camera.fx:.1f} shows only {across_deg:.1f} degrees across; check that '
            f'it is in px of pictures of '
            f'{size_text(camera.image_size)}'))
    size, (unseen, near), angles = _size_doubt(camera, path), _unseen(camera), _angles(camera)
    if angles < FEW_ANGLES and not size:
        found.append(Notice(
            'E-CALIBRATION-PINCUSHION',
            f'{path}: with {_coefficients(camera)} the picture shows {100 * angles:.0f} % of the '
            f'angle without, as few lenses do; check the order and the units of the '
            f'coefficients'))
    if unseen and not size:
        found.append(Notice(
            'E-CALIBRATION-FOLDS',
            f'{path} has no ray for {100 * unseen:.0f} % of the picture: with '
            f'{_coefficients(camera)} it folds {near:.0f} px from its centre; calibrate again, '
            f'unless nothing is visible there'))
    return (*found, *size)


def _size_doubt(camera: Camera, path: object) -> tuple[Notice, ...]:
    size = camera.image_size
    if _off(camera, size) <= AS_GIVEN:
        return ()
    centre, other = f'{path}: the centre ({camera.cx:.1f}, {camera.cy:.1f})', _size_of(camera)
    if other is None:
        return (Notice('E-CALIBRATION-CENTRE',
                       f'{centre} is {100 * _off(camera, size):.0f} % of the picture off the '
                       f'middle of {size_text(size)}; correct it or the size, unless these are a '
                       f'part of larger pictures'),)
    resize = (export_command(str(path), f'--size {size_text(size)}') if same_shape(other, size)
              else 'dashcalib export with --size or --crop')
    return (Notice('E-CALIBRATION-OTHER-SIZE',
                   f'{centre} is that of pictures of about {size_text(other)}, not of '
                   f'{size_text(size)}; write the size that it is for; if the pictures were '
                   f'resized since, then {resize}'),)


def _size_of(camera: Camera) -> tuple[int, int] | None:
    width, height = camera.image_size
    multiples = [(round(width * n / m), round(height * n / m))
                 for n in range(1, MOST_PARTS + 1) for m in range(1, MOST_PARTS + 1) if n != m]
    best = min((*SIZES, *multiples), key=lambda size: _off(camera, size))
    if _off(camera, best) <= FITS:
        return best
    across, down = round(2 * camera.cx + 1), round(2 * camera.cy + 1)
    plausible = min(across, down) > 1 and SHAPES[0] <= across / down <= SHAPES[1]
    return (across, down) if plausible else None


def _off(camera: Camera, size: tuple[int, int]) -> float:
    """Return how far the centre is from the middle of pictures of a size, as a share of it."""
    return max(abs((camera.cx + 0.5) / size[0] - 0.5), abs((camera.cy + 0.5) / size[1] - 0.5))


def _unseen(camera: Camera) -> tuple[float, float]:
    """Return the share of the picture without a ray, and how near to the centre it begins, px."""
    pixels = _pixels(camera)
    with np.errstate(all='ignore'):
        unseen = pixels[~np.isfinite(camera.rays(pixels)).all(axis=-1)]
    away = np.linalg.norm(unseen - [camera.cx, camera.cy], axis=-1)
    return len(unseen) / len(pixels), float(away.min(initial=np.inf))


def _angles(camera: Camera) -> float:
    pixels = _pixels(camera)
    with np.errstate(all='ignore'):
        seen = np.arccos(np.clip(camera.rays(pixels)[:, 2], -1, 1))
    far = np.linalg.norm((pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy], axis=1)
    known = np.isfinite(seen)
    return float(seen[known].max(initial=0.0) / np.arctan(far[known].max(initial=1e-9)))


def _aspect_text(camera: Camera, path: object) -> str:
    return (f'{path}: fy = {camera.fy:.1f} is {camera.fy / camera.fx:.3g} times fx = '
            f'{camera.fx:.1f}')


def _pixels(camera: Camera) -> Floats:
    """Return (n, 2) the middles of cells that share the picture."""
    u, v = np.meshgrid(*((np.arange(count) + 0.5) / count * side - 0.5
                         for count, side in zip(FINE, camera.image_size, strict=True)))
    return np.stack([u.ravel(), v.ravel()], -1)


def _coefficients(camera: Camera) -> str:
    return ', '.join(f'{name} = {value:.4g}' for name, value in list(camera.named.items())[4:]
                     if value) or 'no distortion'
