# SPDX-License-Identifier: Apache-2.0
"""What moves on a terminal while a stage works."""
from __future__ import annotations

import pytest
from rich.progress import Task

from dashcalib_ros.cli.terminal import STEPS, STILL_S, MovingBar


@pytest.mark.parametrize(('still_s', 'pulses'), [(0.5 * STILL_S, False), (1.5 * STILL_S, True)])
def test_a_bar_that_stands_for_long_pulses(still_s, pulses):
    task = Task(1, 'stage', STEPS, STEPS / 2, _get_time=lambda: 100.0,
                fields={'since': 100.0 - still_s})
    task.start_time = 0.0
    assert MovingBar(16).render(task).pulse == pulses
