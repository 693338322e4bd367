"""A recorded drive as another camera in its place would have seen it: real pictures, known lens.

The pictures are resampled for another lens, mirrored, cropped, halved, darkened or cut in time.
What the recording's own calibration is off shows in every view alike: KITTI's nominal one has no
distortion, its pictures have k1 = 0.017.
"""
from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from dashcalib_ros import open_frames
from dashcalib_ros.demo import Lens
from dashcalib_ros.frames import Frame

Grey = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class View:
    """What becomes of each picture.

    lens: of the camera that looks in the same direction from the same place; None: the recording's
    own. mirrored: left is right, before that. light: the grey values are multiplied by it. noise:
    added, in grey values; blur: sigma, px; jpeg_quality: 0 for none. frames: the first one and the
    one after the last.
    """

    name: str
    lens: Lens | None = None
    mirrored: bool = False
    light: float = 1.0
    noise: float = 0.0
    blur: float = 0.0
    jpeg_quality: int = 0
    frames: tuple[int, int | None] = (0, None)


# all within KITTI 03's picture: 1242x375, f 721.5377, centre (609.5593, 172.854)
BARREL = Lens(1000, 300, 700.0, 700.0, 497.0, 140.0, -0.25, 0.07)
STRONG = Lens(940, 270, 690.0, 693.0, 468.0, 130.0, -0.35, 0.13)
PINCUSHION = Lens(1150, 325, 640.0, 640.0, 564.0, 154.0, 0.10, 0.02)
HALF = Lens(621, 187, 360.76885, 360.76885, 304.52965, 86.177)
MIDDLE = Lens(800, 375, 721.5377, 721.5377, 389.5593, 172.854)
RIGHT = Lens(1142, 375, 721.5377, 721.5377, 509.5593, 172.854)
TALL = Lens(1242, 378, 721.5377, 728.753077, 609.5593, 174.58254)

VIEWS = tuple(View(f'kitti03, {name}', **options) for name, options in (
    ('mirrored', {'mirrored': True}),
    ('barrel', {'lens': BARREL}),
    ('strong barrel', {'lens': STRONG}),
    ('strong barrel, mirrored', {'lens': STRONG, 'mirrored': True}),
    ('pincushion', {'lens': PINCUSHION}),
    ('half size', {'lens': HALF}),
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


@dataclass(frozen=True)
class Viewed:
    """A recording through a view: iterable over its frames. truth_path: of the recording."""

    view: View
    recording: Path
    truth_path: Path

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames in order."""
        view, rng = self.view, np.random.default_rng(0)
        maps = self._maps()
        for frame in open_frames(self.recording):
            first, end = view.frames
            if frame.index < first or (end is not None and frame.index >= end):
                continue
            image = np.ascontiguousarray(frame.image[:, ::-1]) if view.mirrored else frame.image
            if maps is not None:
                image = cv2.remap(image, *maps, cv2.INTER_LANCZOS4)
            image = _worse(image, view, rng)
            yield Frame(frame.index - first, frame.stamp_ns, image)

    @property
    def truth(self) -> dict[str, float]:
        """Return fx .. k2, width and height of the camera whose pictures these would be."""
        lens = self.view.lens
        return asdict(self._own() if lens is None else lens)

    def _own(self) -> Lens:
        """Return the recording's lens, mirrored where the pictures are."""
        truth: Mapping[str, Any] = json.loads(self.truth_path.read_text())
        lens = Lens(**{key: truth[key] for key in Lens.__dataclass_fields__})
        if not self.view.mirrored:
            return lens
        return Lens(**{**asdict(lens), 'cx': lens.width - 1 - lens.cx})

    def _maps(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]] | None:
        """Return where in the recording, which has no distortion, each pixel of the lens lies."""
        lens, own = self.view.lens, self._own()
        if lens is None:
            return None
        grid = np.stack(np.meshgrid(np.arange(lens.width), np.arange(lens.height)), axis=-1)
        rays = cv2.undistortPoints(
            grid.reshape(-1, 1, 2).astype(np.float64), lens.matrix, lens.distortion,
            criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12))
        x, y = np.moveaxis(rays.reshape(lens.height, lens.width, 2), -1, 0)
        return ((own.fx * x + own.cx).astype(np.float32),
                (own.fy * y + own.cy).astype(np.float32))


def _worse(image: Grey, view: View, rng: np.random.Generator) -> Grey:
    """Return the picture as a worse camera gives it."""
    made: npt.NDArray[Any] = image
    # half the size needs a filter against aliasing, too
    blur = view.blur or (0.8 if view.lens is HALF else 0.0)
    if blur:
        made = cv2.GaussianBlur(made, (0, 0), blur)
    if view.light != 1.0 or view.noise:
        made = view.light * made + rng.normal(0.0, view.noise, made.shape)
        made = np.clip(np.rint(made), 0, 255).astype(np.uint8)
    if view.jpeg_quality:
        code = cv2.imencode('.jpg', made, [cv2.IMWRITE_JPEG_QUALITY, view.jpeg_quality])[1]
        made = cv2.imdecode(code, cv2.IMREAD_GRAYSCALE)
    return np.asarray(made, np.uint8)
