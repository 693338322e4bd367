"""Prior knowledge of a camera's parameters."""
from __future__ import annotations

from dataclasses import dataclass

from dashcalib_ros.arrays import Floats


@dataclass(frozen=True)
class Prior:
    """A normal distribution of the n parameters: mean (n,), covariance (n, n)."""

    mean: Floats
    covariance: Floats
