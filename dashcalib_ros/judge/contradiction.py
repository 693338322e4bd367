"""When two calibrations contradict each other, and by how much good ones may differ.

The node compares the calibration in use with a new one of which only sigmas are known; check
compares a given one with a whole solution (difference.py). Both allow the same for good ones.
"""
from __future__ import annotations

import math
from collections.abc import Mapping

from dashcalib_ros.camera import Camera

# combined sigmas; a larger difference is a contradiction
CONTRADICTION = 3.0
# of fx; least sigma: good calibrations of one lens differ by this much, also with smaller sigmas
LEAST_SIGMA = 0.0025
# in every model fx and fy are the scale on the axis, so that two models of one lens agree in them;
# the coefficients of distortion are not compared: they are correlated with the focal length
COMPARED = ('fx', 'fy', 'cx', 'cy')


def contradicted(old: Camera, old_sigma: Mapping[str, float] | None, new: Camera,
                 new_sigma: Mapping[str, float]) -> list[str]:
    """Return texts for the parameters in which the two contradict each other."""
    found = []
    floor = LEAST_SIGMA * old.fx
    for name in COMPARED:
        before, after = getattr(old, name), getattr(new, name)
        own = old_sigma[name] if old_sigma is not None else 0.0
        spread = math.hypot(max(own, floor), max(new_sigma[name], floor))
        if abs(after - before) > CONTRADICTION * spread:
            found.append(f'{name} {after:.1f} instead of {before:.1f} px')
    return found
