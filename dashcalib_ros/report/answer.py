"""What a drive says of a given calibration, as JSON has it: dashcalib check, and the node."""
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dashcalib_ros.judge import Check, Odometry
from dashcalib_ros.report.result import plain_values


def answer_dict(found: Check, changes: Sequence[str], motion: Odometry | None = None
                ) -> dict[str, Any]:
    """Return the answer as types of strict JSON.

    changes: of the camera during the drive, in words. motion: the comparison with true poses.
    """
    values: dict[str, Any] = plain_values(found) | {'changes': list(changes)}
    if motion is not None:
        values |= motion.medians()
        values['turns'] = [{'center': turn.turn.number, 'true_deg': turn.angle_deg,
                            'length_m': turn.length_m,
                            'rotation_deg': {name: turn.rotation_deg(name)
                                             for name in motion.names},
                            'scale_drift': {name: turn.scale_drift(name)
                                            for name in motion.names}}
                           for turn in motion.turns]
    return values
