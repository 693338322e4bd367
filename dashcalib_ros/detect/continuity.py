# SPDX-License-Identifier: Apache-2.0
"""Whether an image follows the one before without a loss: by the motion of the points.

From one image to the next the speed of the car hardly changes; what changes quickly are the
camera's angles, on a bumpy road. Let u be a point's step between the two images before, and v its
step to the image in question. Small changes of yaw and pitch shift the whole picture, those of
roll turn it:

    v = ratio u + shift + roll

Nothing is lost where most points can be followed and agree with this, and the ratio is about 1.
It is a little larger, as what comes nearer moves faster; in a sharp turn it is up to 1.5, as the
picture turns about a vertical axis, which is not quite a shift. One lost image makes it more than
2, and more of them make it larger; a repeated image makes it 0.
"""
from __future__ import annotations

import numpy as np

from dashcalib_ros.arrays import Floats, Floats32
from dashcalib_ros.robust import LinearFit, cauchy_fit

# fewer points prove nothing
MIN_POINTS = 30
# of the points; in slow series that lose more from image to image, chance may look alike
MIN_SHARE = 0.25
# of the smallest share in the images before; at 10 images a second it is more without a loss
SHARE_KEPT = 0.6
# of a point's step to the one before, up or down: about the root of 3, two lost images' ratio
MAX_RATIO = 1.7
# a point agrees when it is this far, px, and this share of its step, from where it should be
AGREES_PX, AGREES_SHARE = 1.0, 0.15


def goes_on(first: Floats32, middle: Floats32, last: Floats32, followed: float, usual: float
            ) -> bool:
    """Return whether the last of three images follows the other two, which are neighbours.

    first, middle, last: (n, 2) px, the same points in each. followed: the share of the middle
    image's points that were found in the last one; usual: the smallest such share before.

    Returns False also where there are too few points. While the car stands a loss does
    not show.
    """
    if len(last) < MIN_POINTS:
        return False
    before, now = (np.asarray(step, np.float64) for step in (middle - first, last - middle))
    ratio, off = _ratio(before, now, np.asarray(middle, np.float64))
    agree = off < AGREES_PX + AGREES_SHARE * np.linalg.norm(now, axis=1)
    share = followed * float(agree.mean())
    return (1 / MAX_RATIO < ratio < MAX_RATIO
            and share > max(MIN_SHARE, SHARE_KEPT * usual))


# px; a standing car's points move so much by noise, whatever its speed
STILL_PX = 0.3


def _ratio(before: Floats, now: Floats, xy: Floats) -> tuple[float, Floats]:
    """Return how much longer the steps have become, and (n,) how far each point is off, px.

    before, now: (n, 2) px, two steps of the points; xy: (n, 2) px, where they are.
    """
    around = xy - xy.mean(axis=0)
    around /= max(np.abs(around).max(), 1.0)
    one, none = np.ones(len(xy)), np.zeros(len(xy))
    design = np.stack([before, np.stack([one, none], 1), np.stack([none, one], 1),
                       np.stack([-around[:, 1], around[:, 0]], 1)], axis=2)
    # the first parameter is the ratio less 1: 0 where nothing determines it. As if each point had
    # moved by STILL_PX more; and equal points determine no roll
    wanted = now - before
    found = fitted_steps(design, wanted, np.array([0.0, *np.median(wanted, axis=0), 0.0]),
                         np.array([STILL_PX ** 2, 0.0, 0.0, 0.0]))
    return 1.0 + float(found.params[0]), found.off


# of new weights; the fit has settled after half of them
ROUNDS = 10
# px²; a parameter that no point determines is 0
LEAST_NORMAL = 1e-6


def fitted_steps(design: Floats, wanted: Floats, start: Floats, prior: Floats) -> LinearFit:
    """Return the fit of k parameters to most points' steps.

    design: (n, 2, k) px for a unit of each parameter. wanted: (n, 2) px. start: (k,), the first
    guess. prior: (k,), px² for a unit, of each point: what pulls a parameter to 0.
    """
    return cauchy_fit(design, wanted, lambda off: max(float(np.median(off)), STILL_PX), ROUNDS,
                      start=start, prior=lambda weights: weights.sum() * prior + LEAST_NORMAL)
