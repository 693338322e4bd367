# SPDX-License-Identifier: Apache-2.0
"""A drive as another camera in its place would have seen it: its pictures, another known lens.

The pictures are resampled for another lens, mirrored, cropped, shrunk, darkened or cut in time. A
recorded drive keeps its real pictures so. What its own calibration is off shows in every view
alike: KITTI's nominal one has no distortion, its pictures have k1 = 0.017. A rendered drive gets
what the renderer has not: p1, p2 and k3, which real lenses have and the calibration holds at zero.
"""
from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from drives import BY_NAME, drive_of, pictures_of

from dashcalib_ros import open_frames
from dashcalib_ros.camera.rotation import rotation_matrices
from dashcalib_ros.demo import Lens
from dashcalib_ros.demo.drive import AnyLens
from dashcalib_ros.input import Frame

Grey = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class View:
    """What becomes of each picture.

    lens: of the camera in the same place; None: the drive's own. extra: its p1, p2, k3.
    turned_deg: the rotation vector from the drive's camera to that one's axes. mirrored: left is
    right, before that. shrink: so many pixels in a row, and as many rows, become the mean of them,
    before that. light: the grey values are multiplied by it. noise: added, in grey values; blur:
    sigma, px; jpeg_quality: 0 for none. frames: the first one and the one after the last.
    """

    name: str
    lens: Lens | None = None
    extra: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turned_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mirrored: bool = False
    shrink: int = 1
    light: float = 1.0
    noise: float = 0.0
    blur: float = 0.0
    jpeg_quality: int = 0
    frames: tuple[int, int | None] = (0, None)


# all within KITTI 03's picture: 1242x375, f 721.5377, centre (609.5593, 172.854)
BARREL = Lens(1000, 300, 700.0, 700.0, 497.0, 140.0, -0.25, 0.07)
STRONG = Lens(940, 270, 690.0, 693.0, 468.0, 130.0, -0.35, 0.13)
PINCUSHION = Lens(1150, 325, 640.0, 640.0, 564.0, 154.0, 0.10, 0.02)
MIDDLE = Lens(800, 375, 721.5377, 721.5377, 389.5593, 172.854)
RIGHT = Lens(1142, 375, 721.5377, 721.5377, 509.5593, 172.854)
TALL = Lens(1242, 378, 721.5377, 728.753077, 609.5593, 174.58254)

VIEWS = tuple(View(f'kitti03, {name}', **options) for name, options in (
    ('mirrored', {'mirrored': True}),
    ('barrel', {'lens': BARREL}),
    ('strong barrel', {'lens': STRONG}),
    ('strong barrel, mirrored', {'lens': STRONG, 'mirrored': True}),
    ('pincushion', {'lens': PINCUSHION}),
    ('half size', {'shrink': 2}),
    ('a third', {'shrink': 3}),
    ('middle 800 px', {'lens': MIDDLE}),
    ('100 px cut at the left', {'lens': RIGHT}),
    ('fy/fx 1.01', {'lens': TALL}),
    ('a third of the light, noise 4', {'light': 0.35, 'noise': 4.0}),
    ('blur 1.2', {'blur': 1.2}),
    ('JPEG 30', {'jpeg_quality': 30}),
    ('first 500', {'frames': (0, 500)}),
    ('without its sharp turn', {'frames': (110, None)}),
))
BY_VIEW = {view.name: view for view in VIEWS}


# k1, k2 and p1, p2, k3 of lenses that are not quite what the calibration takes them for
INEXACT = {
    'p1, p2 0.001': (-0.30, 0.10, (0.001, -0.001, 0.0)),
    'p1, p2 0.003': (-0.30, 0.10, (-0.003, 0.003, 0.0)),
    'k3 -0.03': (-0.30, 0.10, (0.0, 0.0, -0.03)),
    'k3 0.1': (-0.30, 0.10, (0.0, 0.0, 0.1)),
    "KITTI's raw lens with p1, p2, k3": (-0.3729, 0.2037, (0.0022, 0.0014, -0.0723)),
}

# rendered drives and how many times smaller their pictures become
SMALL = {f'{name}, 1/{shrink}': (name, shrink)
         for name in ('KITTI raw lens, 1392x512', 'dashcam: bonnet, text',
                      '640x480, fy/fx 1.01, noise 3')
         for shrink in (2, 3)}


@dataclass(frozen=True)
class Viewed:
    """A drive through a view: iterable over its frames. own: the drive's lens."""

    view: View
    frames: Iterable[Frame]
    own: AnyLens

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames in order."""
        view, rng = self.view, np.random.default_rng(0)
        maps = self._maps()
        first, end = view.frames
        for frame in self.frames:
            if frame.index < first or (end is not None and frame.index >= end):
                continue
            image = np.ascontiguousarray(frame.image[:, ::-1]) if view.mirrored else frame.image
            image = _shrunk(image, view.shrink)
            if maps is not None:
                image = np.asarray(cv2.remap(image, *maps, cv2.INTER_LANCZOS4), np.uint8)
            image = _worse(image, view, rng)
            yield Frame(frame.index - first, frame.stamp_ns, image)

    @property
    def truth(self) -> dict[str, float]:
        """Return fx .. k2, p1, p2, k3, width and height of the camera with these pictures."""
        lens = self.view.lens or self._turned()
        return {**asdict(lens), **dict(zip(('p1', 'p2', 'k3'), self.view.extra, strict=True))}

    def _turned(self) -> AnyLens:
        """Return the drive's lens, mirrored and shrunk as the pictures are."""
        lens, by = self.own, self.view.shrink
        if self.view.mirrored:
            lens = replace(lens, cx=lens.width - 1 - lens.cx)
        return replace(lens, width=lens.width // by, height=lens.height // by,
                       fx=lens.fx / by, fy=lens.fy / by,
                       cx=(lens.cx + 0.5) / by - 0.5, cy=(lens.cy + 0.5) / by - 0.5)

    def _maps(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]] | None:
        """Return where in the drive's pictures each pixel of the lens lies."""
        lens, own = self.view.lens, self._turned()
        if lens is None:
            return None
        grid = np.stack(np.meshgrid(np.arange(lens.width), np.arange(lens.height)), axis=-1)
        distortion = np.array([lens.k1, lens.k2, *self.view.extra])
        rays = cv2.undistortPoints(
            grid.reshape(-1, 1, 2).astype(np.float64), lens.matrix, distortion,
            criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12))
        turned = rotation_matrices(np.radians([self.view.turned_deg]))[0]
        column, row = own.project(cv2.convertPointsToHomogeneous(rays)[:, 0] @ turned).T.reshape(
            2, lens.height, lens.width)
        inside = ((column >= -0.5) & (column <= own.width - 0.5)
                  & (row >= -0.5) & (row <= own.height - 0.5))
        outside = 1 - inside.mean()
        if outside > 0.002:
            raise ValueError(f'{self.view.name}: {100 * outside:.1f} % lie outside the pictures')
        return column.astype(np.float32), row.astype(np.float32)


def recorded_view(name: str, recording: Path, truth_path: Path) -> Viewed:
    """Return a view of a recorded drive. truth_path: of its calibration, without distortion."""
    truth: Mapping[str, Any] = json.loads(truth_path.read_text())
    own = Lens(**{key: truth[key] for key in Lens.__dataclass_fields__ if key in truth})
    return Viewed(BY_VIEW[name], open_frames(recording), own)


def inexact_view(name: str, seed: int, cache: Path) -> Viewed:
    """Return a rendered drive through one of the INEXACT lenses; it is rendered on the way."""
    drive = drive_of(BY_NAME['no distortion'], seed)
    k1, k2, extra = INEXACT[name]
    width, height = 730, 390
    # as large as the rendered pictures can fill
    lens = Lens(width, height, drive.lens.fx, 1.002 * drive.lens.fx, (width - 1) / 2 + 4.0,
                (height - 1) / 2 - 3.0, k1, k2)
    return Viewed(View(name, lens, extra), pictures_of(drive, cache), drive.lens)


def small_view(name: str, seed: int, cache: Path) -> Viewed:
    """Return one of the SMALL drives; it is rendered on the way."""
    setting, shrink = SMALL[name]
    drive = drive_of(BY_NAME[setting], seed)
    return Viewed(View(name, shrink=shrink), pictures_of(drive, cache), drive.lens)


def _shrunk(image: Grey, by: int) -> Grey:
    """Return the means of squares of pixels; what is left over at the right and below is cut."""
    if by == 1:
        return image
    height, width = image.shape[0] // by, image.shape[1] // by
    small = cv2.resize(image[:height * by, :width * by], (width, height),
                       interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)


def _worse(image: Grey, view: View, rng: np.random.Generator) -> Grey:
    """Return the picture as a worse camera gives it."""
    made: npt.NDArray[Any] = image
    if view.blur:
        made = cv2.GaussianBlur(made, (0, 0), view.blur)
    if view.light != 1.0 or view.noise:
        made = view.light * made + rng.normal(0.0, view.noise, made.shape)
        made = np.clip(np.rint(made), 0, 255).astype(np.uint8)
    if view.jpeg_quality:
        code = cv2.imencode('.jpg', made, [cv2.IMWRITE_JPEG_QUALITY, view.jpeg_quality])[1]
        made = np.asarray(cv2.imdecode(code, cv2.IMREAD_GRAYSCALE))
    return np.asarray(made, np.uint8)
