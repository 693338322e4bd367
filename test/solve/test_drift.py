# SPDX-License-Identifier: Apache-2.0
"""A focal length that changes with time: found where it does, and not named where it does not."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from solving import CONFIG, scenes_of, solved
from synthetic import LENS, SIZE

from dashcalib_ros.judge.verdict import judge
from dashcalib_ros.reconstruct.scene import Scene

pytestmark = pytest.mark.usefixtures('no_profile')

MIDDLE = (np.array(SIZE) - 1) / 2


def warming(size: float, count: int = 5) -> list[Scene]:
    """Return turns, a minute apart, whose pictures grow by size from the first to the last."""
    scenes = scenes_of(count, tracks=150)
    found = []
    for n, scene in enumerate(scenes):
        zoom = 1 + size * (n / (count - 1) - 0.5)
        tracks = replace(scene.tracks, xy=MIDDLE + (scene.tracks.xy - MIDDLE) * zoom,
                         stamps_ns=scene.tracks.stamps_ns + n * 60 * 10**9)
        found.append(replace(scene, tracks=tracks))
    return found


@pytest.mark.parametrize('size', [0.02, -0.012])
def test_a_lens_that_warms_up_is_measured(size):
    solution = solved(warming(size))
    assert solution.drift is not None
    assert abs(solution.drift.size - size) < 3 * solution.drift.sigma < 0.012
    assert solution.drift.seconds == pytest.approx(240, rel=0.03)
    assert abs(solution.camera.fx - LENS.fx) < 3 * solution.sigma[0]
    assert 'E-FOCAL-LENGTH-DRIFTS' not in judge(solution, CONFIG.verdict).codes


def test_a_steady_lens_has_no_drift():
    assert solved(warming(0.0)).drift is None


def test_two_turns_cannot_tell():
    assert solved(warming(0.02, 2)).drift is None


def test_a_large_drift_has_no_camera_info():
    assert 'E-FOCAL-LENGTH-DRIFTS' in judge(solved(warming(0.05)), CONFIG.verdict).codes
