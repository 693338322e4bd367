"""What the Calibrator tells after each frame."""
from __future__ import annotations

from dataclasses import dataclass

from dashcalib_ros.arrays import Mask
from dashcalib_ros.detect import TurnId
from dashcalib_ros.detect.motion import TrackedPoints


@dataclass(frozen=True)
class Status:
    """The calibrator's state after a frame.

    frames: pushed so far. turns: in the bank and stored. built: how many scenes a calibration
    would use now; ready: their turns; yaw_deg: the sum of their yaw. stored: how many turns are of
    earlier drives. magnitude: the newest filtered turning magnitude, of the image width.
    yaws_deg: of the turns in ready, in their order. reconstructed: the turns that watch() has
    scenes of, chosen or not.
    """

    frames: int
    turns: int
    built: int
    yaw_deg: float
    magnitude: float
    standing: bool
    ready: tuple[TurnId, ...] = ()
    stored: int = 0
    yaws_deg: tuple[float, ...] = ()
    reconstructed: tuple[TurnId, ...] = ()


@dataclass(frozen=True)
class View:
    """What is seen in the newest frame: for pictures that people look at.

    valid: (h, w) of the frame, or of the frame resized; None: no ego vehicle is known.
    """

    points: TrackedPoints
    valid: Mask | None
