"""A camera as ROS has it: the fields of CameraInfo, and the rectified picture that its P is of.

A rectified picture is a plane, and no plane shows a ray at 90 degrees: near there it is stretched
without limit. Rays beyond WIDEST are therefore left out, except by 'same'. The picture's size
stays, and pixels become square. All follows from the viewing rays, whatever the model is.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera.camera import Camera
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
# of a shift; a view that is no larger elsewhere stays in the middle
STAYS = 0.001
# of an entry of K, R or P; programs write them with more digits
EXACT = 1e-3
# of the width; the middle of the picture is so near to that of the rectified one, which shows it
# at most so many times smaller or larger: P of twice the size moves the middle by half the width
NEAR, ZOOM = 0.1, (0.1, 2.0)


@dataclass(frozen=True)
class RosCamera:
    """CameraInfo's fields, and those of a calibration file: matrices are row-major."""

    image_size: tuple[int, int]
    distortion_model: str
    d: list[float]
    k: list[float]
    r: list[float]
    p: list[float]


def ros_camera(camera: Camera, rectified: str = SAME) -> RosCamera:
    """Return the camera as ROS has it: R is the identity.

    rectified: what P, the camera of the rectified picture, is to show; see rectified_matrix().
    """
    p = np.column_stack([rectified_matrix(camera, rectified), np.zeros(3)])
    return RosCamera(
        camera.image_size, camera.ros_model, [float(value) for value in camera.ros_distortion()],
        camera.matrix.ravel().tolist(), np.eye(3).ravel().tolist(), p.ravel().tolist())


def ros_faults(camera: Camera, k: Sequence[float] | None = None, r: Sequence[float] | None = None,
               p: Sequence[float] | None = None) -> tuple[str, ...]:
    """Return in words what is wrong with CameraInfo's K (9,), R (9,) and P (12,) beside a camera.

    The camera has their focal lengths, centre and distortion, of which this says nothing. None, or
    nothing in it: not known, and no fault. So are R and P of zeros where there is no distortion,
    as simulators have them: nothing is to be rectified. R and P of one camera are meant: those of
    a pair are faults.
    """
    distorted = any(camera.ros_distortion())
    faults = []
    if k:
        faults += _odd('K', np.reshape(k, (3, 3)), camera.matrix)
    if r and (distorted or any(r)):
        rotation = np.reshape(r, (3, 3))
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > EXACT or np.linalg.det(rotation) < 0:
            faults.append('R is not a rotation: for a single camera, it must be the identity')
        elif np.abs(rotation - np.eye(3)).max() > EXACT:
            angle = np.degrees(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1)))
            faults.append(f'R rotates the rectified image by {angle:.1f} degrees: for a single '
                          f'camera, it must be the identity')
    if p and (distorted or any(p)):
        view = np.reshape(p, (3, 4))
        wanted = np.diag([view[0, 0], view[1, 1], 1.0, 0.0])[:3]
        wanted[:2, 2] = view[:2, 2]
        faults += _odd('P', view, wanted) or _of_another_picture(camera, view[:, :3])
    return tuple(faults)


def _odd(name: str, matrix: Floats, wanted: npt.ArrayLike) -> list[str]:
    """Return the entries that are not as they must be."""
    flat, right = matrix.ravel(), np.ravel(wanted)
    odd = np.flatnonzero(~(np.abs(flat - right) <= EXACT))
    texts = (f'{name}[{n}] is {flat[n]:.4g}, not {right[n]:.4g}' for n in odd)
    return [', '.join(texts)] if len(odd) else []


def _of_another_picture(camera: Camera, view: Floats) -> list[str]:
    """Return whether a rectified picture (3, 3) does not show what the camera sees."""
    size = np.array(camera.image_size)
    middle, low, high = (share * (size - 1) for share in (0.5, 0.25, 0.75))
    with np.errstate(all='ignore'):
        seen = camera.rays(np.array([middle, low, high])) @ view.T
        seen = seen[:, :2] / seen[:, 2:]
        away = np.abs(seen[0] - middle).max() / size[0]
        zoom = (seen[2] - seen[1]) / (high - low)
        # NaN is a fault, too
        fits = away <= NEAR and ZOOM[0] <= zoom.min() and zoom.max() <= ZOOM[1]
    return [] if fits else [
        'P does not map the image into the rectified image: it may be for images of another size']


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
    """Return (4 points, 2) pixels all around a picture."""
    x, y = (np.linspace(0, side - 1, points) for side in size)
    right, bottom = x[-1], y[-1]
    return np.concatenate([
        np.column_stack(pair) for pair in (
            (x, np.zeros_like(x)), (np.full_like(y, right), y), (x, np.full_like(x, bottom)),
            (np.zeros_like(y), y))])


def _outline(camera: Camera) -> Floats:
    """Return (n, 2) points at depth 1 all around what the lens sees."""
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
        return np.asarray(width(centres) - STAYS * np.linalg.norm(centres, axis=-1))

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
