# SPDX-License-Identifier: Apache-2.0
"""The rectified picture, without distortion: what it shows, and where each of its pixels is seen.

It is a plane, and no plane shows a ray at 90 degrees: near there it is stretched without limit.
Rays beyond WIDEST are therefore left out, except by 'same'. The picture's size stays, and pixels
become square. All follows from the viewing rays, whatever the model is.
"""
from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera.camera import Camera
from dashcalib_ros.camera.field import Field
from dashcalib_ros.errors import ConfigError

# K itself; the largest view without a black border; all that the lens sees
SAME, CROP, ALL = 'same', 'crop', 'all'
RECTIFIED = (SAME, CROP, ALL)
# radians (75 degrees): of a picture so wide, a fifth is left for the middle half of the angles
WIDEST = 1.309
# points on each side of the picture
SIDE_POINTS = 512
# halvings on the way from the principal point to the border
HALVINGS = 30
# in the search for the largest view; about 30 are needed
SEARCH_STEPS = 300
# of a shift; a view that is not larger elsewhere stays in the middle
LEAST_SHIFT = 0.001
# px; outside of the picture, for what the lens does not see: cv2.remap leaves it black
OUTSIDE = -1.0


def rectify(image: npt.NDArray[Any], camera: Camera, rectified: str = SAME,
            field: Field | None = None) -> npt.NDArray[Any]:
    """Return an image (h, w) or (h, w, channels) without distortion; black where nothing is seen.

    image: of the camera's size. rectified: as in rectified_matrix(). field: what the camera
    leaves over.
    """
    # cv2's stubs do not know that both maps may be in one
    remap: Any = cv2.remap
    return np.asarray(remap(image, source_map(camera, rectified, field), None, cv2.INTER_LINEAR))


@lru_cache(maxsize=1)
def source_map(camera: Camera, rectified: str = SAME, field: Field | None = None
               ) -> npt.NDArray[np.float32]:
    """Return (h, w, 2): where each pixel of the rectified picture is in the image, px.

    OUTSIDE where the lens does not see it. See rectify().
    """
    matrix = rectified_matrix(camera, rectified)
    width, height = camera.image_size
    source = np.empty((height, width, 2), np.float32)
    for row in range(height):  # rays of a whole large picture are some 100 MB
        pixels = np.stack([np.arange(float(width)), np.full(width, float(row))], axis=-1)
        source[row] = np.nan_to_num(seen_at(pixels, matrix, camera, field), nan=OUTSIDE)
    return source


def seen_at(pixels: Floats, matrix: Floats, camera: Camera, field: Field | None = None) -> Floats:
    """Return (..., 2) where the image has what the rectified picture shows at pixels (..., 2).

    matrix: K (3, 3) of the rectified picture. NaN where the lens does not see it.
    """
    ahead = (pixels - matrix[:2, 2]) / matrix[[0, 1], [0, 1]]
    found = camera.project(np.concatenate([ahead, np.ones((*pixels.shape[:-1], 1))], axis=-1))
    return found if field is None else field.observed(found)


def rectified_matrix(camera: Camera, rectified: str = SAME) -> Floats:
    """Return K (3, 3) of the rectified picture: SAME, CROP or ALL.

    SAME: the camera's own. CROP: of all that have a source for every pixel, the one that shows
    most. ALL: everything that the lens sees is in the picture, and the rest is black.
    """
    if rectified not in RECTIFIED:
        raise ConfigError('E-CONFIG-CHOICE',
                          f'rectified must be one of {", ".join(RECTIFIED)}, not {rectified!r}')
    if rectified == SAME:
        return camera.matrix
    with np.errstate(all='ignore'):
        matrix = (_all if rectified == ALL else _crop)(camera)
    # a file may hold a camera that sees nothing
    return matrix if np.isfinite(matrix).all() else camera.matrix


def _all(camera: Camera) -> Floats:
    outline = _outline(camera)
    low, high = outline.min(axis=0), outline.max(axis=0)
    focal = float((_middle(camera) / ((high - low) / 2)).min())
    return _matrix(camera, (low + high) / 2, focal)


def _crop(camera: Camera) -> Floats:
    centre, focal = _largest_inside(camera, _outline(camera))
    # the outline is known at points only: a little less may be seen between them
    for _ in range(100):
        if _has_source_everywhere(camera, _matrix(camera, centre, focal)):
            break
        focal *= 1.0005
    return _matrix(camera, centre, focal)


def _middle(camera: Camera) -> Floats:
    return (np.array(camera.image_size) - 1) / 2


def _matrix(camera: Camera, centre: Floats, focal: float) -> Floats:
    """Return K of the picture with square pixels whose middle shows a point (2,) at depth 1."""
    cx, cy = _middle(camera) - focal * centre
    return np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])


def _border(size: tuple[int, int], points: int) -> Floats:
    x, y = (np.linspace(0, side - 1, points) for side in size)
    right, bottom = x[-1], y[-1]
    return np.concatenate([
        np.column_stack(pair) for pair in (
            (x, np.zeros_like(x)), (np.full_like(y, right), y), (x, np.full_like(x, bottom)),
            (np.zeros_like(y), y))])


def _outline(camera: Camera) -> Floats:
    centre = np.array([camera.cx, camera.cy])
    reach = _border(camera.image_size, SIDE_POINTS) - centre
    seen, unseen = np.zeros(len(reach)), np.ones(len(reach))
    share = unseen
    for _ in range(HALVINGS):
        rays = camera.rays(centre + share[:, None] * reach)
        ok = rays[:, 2] >= np.cos(WIDEST)  # no ray is NaN, and not seen
        seen, unseen = np.where(ok, share, seen), np.where(ok, unseen, share)
        if ok.all() and share.min() == 1.0:
            break
        share = np.where(seen == 1.0, 1.0, (seen + unseen) / 2)
    rays = camera.rays(centre + seen[:, None] * reach)
    return np.asarray(rays[:, :2] / rays[:, 2:])


def _largest_inside(camera: Camera, outline: Floats) -> tuple[Floats, float]:
    """Return centre (2,) and focal length of the largest view that no outline point is in."""
    half = _middle(camera) / camera.image_size[0]

    def width(centres: Floats) -> Floats:
        away = np.abs(outline - centres[..., None, :]) / half
        return np.asarray(away.max(axis=-1).min(axis=-1))

    def worth(centres: Floats) -> Floats:
        return np.asarray(width(centres) - LEAST_SHIFT * np.linalg.norm(centres, axis=-1))

    around = np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]), -1).reshape(-1, 2)
    low, high = outline.min(axis=0), outline.max(axis=0)
    centre, step = np.zeros(2), (high - low) / 8
    for _ in range(SEARCH_STEPS):
        if step.max() < 1e-6:
            break
        near = np.clip(centre + around * step, low, high)
        best = near[worth(near).argmax()]
        if worth(best) > worth(centre):
            centre = best
        else:
            step = step / 2
    return centre, float(camera.image_size[0] / width(centre))


def _has_source_everywhere(camera: Camera, matrix: Floats) -> bool:
    """Return whether each pixel of the rectified picture's border is seen by the camera."""
    width, height = camera.image_size
    border = _border(camera.image_size, max(width, height))
    rays = np.column_stack([(border - matrix[:2, 2]) / matrix[0, 0], np.ones(len(border))])
    found = camera.project(rays)
    return bool(((found >= 0) & (found <= [width - 1, height - 1])).all())
