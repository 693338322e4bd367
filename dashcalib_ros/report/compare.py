"""Two calibrations side by side: how far apart, by how many sigmas, and what it does to pixels."""
from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

from dashcalib_ros.errors import InputError
from dashcalib_ros.report.camera import PARAMETERS, Camera
from dashcalib_ros.report.mapping import mapping_error
from dashcalib_ros.report.result import plain_values


@dataclass(frozen=True)
class Difference:
    """One parameter of both. difference is a - b; percent is of b, None where b is zero.

    sigma: of the difference, from whichever side knows its own (both: root of the squares' sum).
    z: difference in those sigmas. Both None when neither side knows a sigma.
    """

    name: str
    a: float
    b: float
    difference: float
    percent: float | None
    sigma: float | None
    z: float | None


@dataclass(frozen=True)
class Comparison:
    """What compare() found. mapping_px: RMS over the image; None where b's model folds over."""

    a: Camera
    b: Camera
    differences: tuple[Difference, ...]
    mapping_px: float | None

    def as_dict(self) -> dict[str, Any]:
        """Return all of it as strict JSON's values."""
        sides = {side: {'name': camera.name, 'verdict': camera.verdict}
                 for side, camera in (('a', self.a), ('b', self.b))}
        rows = {d.name: dataclasses.asdict(d) for d in self.differences}
        for row in rows.values():
            del row['name']
        plain: dict[str, Any] = plain_values({
            **sides, 'image_size': self.b.image_size, 'parameters': rows,
            'mapping_px': self.mapping_px})
        return plain


def compare(a: Camera, b: Camera) -> Comparison:
    """Compare camera a with the reference b. Raises InputError when the image sizes differ."""
    if a.image_size != b.image_size:
        raise InputError(
            f'{a.name} is for {a.image_size[0]} x {a.image_size[1]} images and {b.name} for '
            f'{b.image_size[0]} x {b.image_size[1]}; compare calibrations of the same image size')
    rows = tuple(_difference(name, a, b) for name in PARAMETERS)
    extra = tuple(_difference(name, a, b) for name in ('p1', 'p2', 'k3')
                  if getattr(a, name) or getattr(b, name))
    return Comparison(a, b, rows + extra, mapping_error(a, b))


def _difference(name: str, a: Camera, b: Camera) -> Difference:
    value, reference = _value(a, name), _value(b, name)
    difference = value - reference
    sigmas = [getattr(camera.sigma, name) for camera in (a, b)
              if camera.sigma is not None and name in PARAMETERS]
    sigma = math.hypot(*sigmas) if sigmas else None
    return Difference(name, value, reference, difference,
                      100 * difference / abs(reference) if reference else None,
                      sigma, difference / sigma if sigma else None)


def _value(camera: Camera, name: str) -> float:
    value: float = getattr(camera.intrinsics if name in PARAMETERS else camera, name)
    return value
