# SPDX-License-Identifier: Apache-2.0
"""A drive through a town on paper: what a gyro and GPS see of it."""
from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from dashcalib_ros.input.motion import Samples

STEP_S = 0.01


def town(seed, turns=12, straight_s=12.0, speed=10.0, scale=1.0, noise_m=0.5, rate_hz=1.0,
         density_deg=0.1, bias_deg=0.2, jumps=0.0, late_s=0.0, lever_m=1.0, mounting=None):
    """Return a gyro's rates, rad/s, and positions, m. jumps: share of the fixes."""
    rng = np.random.default_rng(seed)
    rates = []
    for _ in range(turns):
        rates += [0.0] * int(straight_s * rng.uniform(0.6, 1.4) / STEP_S)
        angle, count = np.radians(rng.choice([-90, 90, 60, -45])), int(rng.uniform(3, 6) / STEP_S)
        bend = 1 - np.cos(2 * np.pi * np.arange(count) / count)
        rates += list(angle / (count * STEP_S) * bend)
    rate = np.array(rates + [0.0] * int(straight_s / STEP_S))
    stamps_s, yaw = STEP_S * np.arange(len(rate)), np.cumsum(rate) * STEP_S + rng.uniform(0, 6)
    ahead = np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], axis=1)
    # the aerial is not above the rear axle
    place = np.cumsum(speed * STEP_S * ahead, axis=0) + lever_m * ahead
    sensor = mounting or Rotation.random(random_state=seed)
    seen = (scale * sensor.apply(rate[:, None] * [0, 0, 1])
            + np.radians(bias_deg) * rng.standard_normal(3)
            + np.radians(density_deg) / STEP_S**0.5 * rng.standard_normal((len(rate), 3)))
    fixes = slice(None, None, round(1 / rate_hz / STEP_S))
    where = place[fixes] + noise_m * rng.standard_normal(place[fixes].shape)
    jumped = rng.random(len(where)) < jumps
    where[jumped] += 30 * rng.standard_normal((jumped.sum(), 3))
    return Samples(stamps_s, seen), Samples(stamps_s[fixes] + late_s, where)
