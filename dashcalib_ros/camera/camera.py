# SPDX-License-Identifier: Apache-2.0
"""What every camera model has: parameters, projection, viewing rays, derivatives, limits.

A model is a frozen dataclass that adds its distortion coefficients to fx, fy, cx, cy, and one row
in models.py. Directions are unit vectors, since a ray may lie beyond 90 degrees; errors are
pixels. Pixel coordinates are ROS's and OpenCV's: the centre of the first pixel is (0, 0).
"""
from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import numpy.typing as npt

from dashcalib_ros.arrays import Floats, Pixels

if TYPE_CHECKING:
    from typing_extensions import Self

# COLMAP has the centre of the first pixel at (0.5, 0.5)
HALF_PIXEL = 0.5
# a coefficient below this moves no pixel, and as a polynomial's highest one it spoils the roots
TINY = 1e-30
# the families of lenses: distortion of the tangent of a ray's angle to the axis, or of the angle
PINHOLE, FISHEYE = 'pinhole', 'fisheye'


def resized_pixels(pixels: Pixels, factor: float | np.float32) -> Pixels:
    """Return where pixels (..., 2) are in pictures that are factor times as large."""
    return (pixels + HALF_PIXEL) * factor - HALF_PIXEL


@dataclass(frozen=True)
class ColmapModel:
    """How COLMAP writes a camera.

    name: of COLMAP's model; size: how many parameters it has. places: the index of each of our
    parameters among them. COLMAP's other parameters are 0.
    """

    name: str
    size: int
    places: tuple[int, ...]

    def values(self, params: npt.ArrayLike) -> Floats:
        """Return COLMAP's parameters (size,) for ours."""
        values = np.zeros(self.size)
        values[list(self.places)] = np.asarray(params)
        values[list(self.places[2:4])] += HALF_PIXEL
        return values


@dataclass(frozen=True)
class Camera(ABC):
    """image_size: (width, height); fx, fy, cx, cy in pixels; the rest is the model's own.

    model: its name in result.json and --model. ros_model: CameraInfo's distortion_model.
    family: PINHOLE or FISHEYE; within one, a coefficient has one meaning. given_only:
    whether no turns can determine its coefficients: then it may only be read from files.
    colmap: how COLMAP writes it. spread: prior standard deviation of each distortion
    coefficient, around 0. focal_ratios: focal lengths over the image width that the search for a
    start tries.
    sees_behind: whether it projects rays beyond 90 degrees from its axis.
    """

    image_size: tuple[int, int]
    fx: float
    fy: float
    cx: float
    cy: float

    model: ClassVar[str]
    ros_model: ClassVar[str]
    family: ClassVar[str]
    given_only: ClassVar[bool] = False
    colmap: ClassVar[ColmapModel]
    spread: ClassVar[tuple[float, ...]]
    # 126 to 29 degrees across, without distortion
    focal_ratios: ClassVar[tuple[float, ...]] = tuple(0.256 * 1.25**n for n in range(10))
    sees_behind: ClassVar[bool] = False

    @classmethod
    def centred(cls, image_size: tuple[int, int], focal: float, *distortion: float) -> Self:
        """Return the camera that the paper's first step starts from: fx = fy, centre fixed.

        distortion: the first coefficients; the others are 0.
        """
        width, height = image_size
        params = np.zeros(len(cls.names()))
        params[:4] = focal, focal, (width - 1) / 2, (height - 1) / 2
        params[4:4 + len(distortion)] = distortion
        return cls.of(image_size, params)

    @classmethod
    def of(cls, image_size: tuple[int, int], params: npt.ArrayLike) -> Self:
        """Return the camera with these parameters, in the order of names()."""
        return cls(image_size, *(float(value) for value in np.asarray(params)))

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Return the parameters' names: fx, fy, cx, cy, then the distortion coefficients."""
        return tuple(spec.name for spec in fields(cls))[1:]

    @property
    def params(self) -> Floats:
        """Return the parameters (n,) in the order of names()."""
        return np.array([getattr(self, name) for name in self.names()])

    @property
    def named(self) -> dict[str, float]:
        """Return the parameters by name."""
        return {name: getattr(self, name) for name in self.names()}

    def units(self, px: float) -> Floats:
        """Return (n,) the units of the parameters in pictures px times as large, for sigmas.

        fx, fy, cx and cy are pixels; the other parameters have no unit.
        """
        return np.where(np.arange(len(self.names())) < 4, px, 1.0)

    def with_params(self, params: npt.ArrayLike) -> Self:
        """Return the camera with other parameters (n,)."""
        return self.of(self.image_size, params)

    def with_focal(self, focal: float) -> Self:
        """Return the camera with another focal length, fx = fy."""
        return replace(self, fx=focal, fy=focal)

    def resized(self, factor: float, image_size: tuple[int, int],
                factor_y: float | None = None) -> Self:
        """Return the camera of images that are factor times as large as its own.

        image_size: theirs. Pixel x of its own images is (x + 0.5) factor - 0.5 of theirs.
        factor_y: where their height is another multiple, as sizes are whole numbers.
        """
        x, y = factor, factor if factor_y is None else factor_y
        return replace(self, image_size=image_size, fx=self.fx * x, fy=self.fy * y,
                       cx=self.cx * x + (x - 1) / 2, cy=self.cy * y + (y - 1) / 2)

    def zoomed(self, times: float) -> Self:
        """Return the camera of pictures that grew so many times about their middle."""
        x, y = ((side - 1) / 2 for side in self.image_size)
        return replace(self, fx=self.fx * times, fy=self.fy * times,
                       cx=x + times * (self.cx - x), cy=y + times * (self.cy - y))

    def without_distortion(self) -> Self:
        """Return the camera with all distortion coefficients 0."""
        return self.of(self.image_size, [*self.params[:4], *np.zeros(len(self.names()) - 4)])

    @property
    def matrix(self) -> Floats:
        """Return K (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def field_of_view(self) -> tuple[float, float, float]:
        """Return degrees from edge to edge through the picture's middle: horizontal, vertical.

        Last comes the larger of both diagonals; NaN where not known. The two sides of one
        direction may come to more than 180.
        """
        width, height = self.image_size
        left, right, top, bottom = -0.5, width - 0.5, -0.5, height - 0.5
        x, y = (width - 1) / 2, (height - 1) / 2
        ends = np.array([[(left, y), (right, y)], [(x, top), (x, bottom)],
                         [(left, top), (right, bottom)], [(left, bottom), (right, top)]])
        with np.errstate(all='ignore'):
            off_axis = np.degrees(np.arccos(np.clip(self.rays(ends)[..., 2], -1.0, 1.0)))
            angles = off_axis.sum(axis=1)
        return float(angles[0]), float(angles[1]), float(angles[2:].max())

    def widened(self) -> Camera:
        """Return the same camera in a wider model: its first parameters are this one's.

        The values that the further coefficients would have show how well this model describes the
        lens. Returns the camera itself where no model has more.
        """
        return self

    @abstractmethod
    def ros_distortion(self) -> list[float]:
        """Return CameraInfo's D."""

    @abstractmethod
    def project(self, points: Floats) -> Floats:
        """Return the pixels (..., 2) of points (..., 3) in the camera's frame.

        NaN for points that the model cannot see, such as those behind the camera, and for NaN.
        """

    @abstractmethod
    def rays(self, pixels: Floats) -> Floats:
        """Return the unit viewing rays (..., 3) of pixels (..., 2).

        NaN for NaN, and for pixels beyond the radius at which the model folds over.
        """

    @abstractmethod
    def derivatives(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the derivatives of the pixels of visible points (m, 3), and the pixels (m, 2).

        First the derivatives by the parameters (m, 2, n), then those by the points (m, 2, 3).
        """

    def depths(self, points: Floats) -> Floats:
        """Return (...) by how much the pictures of small surfaces at points (..., 3) shrink."""
        return np.asarray(points[..., 2])

    def covers_picture(self) -> bool:
        """Return whether every pixel has a viewing ray: the model does not fold over inside."""
        width, height = self.image_size
        corners = np.array([[x, y] for x in (0.0, width - 1.0) for y in (0.0, height - 1.0)])
        return bool(np.isfinite(self.rays(corners)).all())
