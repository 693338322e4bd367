# SPDX-License-Identifier: Apache-2.0
"""What kind of drive to render."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from dashcalib_ros.errors import ConfigError

Kind = Literal['drive', 'parked', 'spin']
MAX_FRAME_MS = 200.0
MAX_STABILISED = 0.2


@dataclass(frozen=True)
class Turn:
    """One turn. angle_deg: positive to the left. radius_m: of the rear axle's path."""

    angle_deg: float
    radius_m: float = 10.0


@dataclass(frozen=True)
class Stop:
    """A red light. before_turn: the straight it is on (0 is the first); seconds standing."""

    before_turn: int
    seconds: float


@dataclass(frozen=True)
class Mounting:
    """Where one of several cameras sits on the car, and its clock.

    yaw_left_deg, pitch_up_deg, roll_right_deg: where it looks. ahead_m, left_m: of the middle of
    the rear axle; height_m. phase_s: when it takes its first picture; late_s: added to its stamps,
    and clock_ppm: by how much more time passes between them.
    """

    yaw_left_deg: float = 0.0
    pitch_up_deg: float = 0.0
    roll_right_deg: float = 0.0
    ahead_m: float = 1.7
    left_m: float = 0.1
    height_m: float = 1.4
    phase_s: float = 0.0
    late_s: float = 0.0
    clock_ppm: float = 0.0


@dataclass(frozen=True)
class DriveSpec:
    """A drive; the same spec and lens give the same pictures.

    rate: frames per second. turns: the turns, or how many to make up from the seed (left and
    right alternate, 60 to 100 degrees, radius 8 to 14 m); 0 is a straight drive.
    straight_m: between turns. lead_m: before the first and after the last turn.
    speed_mps on straights, turn_speed_mps in turns, accel_mps2 between them.
    height_m: of the camera; mount_deg: largest yaw, pitch and roll of its mounting.
    vibration_deg: RMS of pitch from the road; roll is 0.7 of it, and
    the body also dives when it brakes and leans in turns. 0 switches all of these off.
    shortest_bump_m: wavelength of the shortest bumps; those below 2.5 m are as much lower.
    noise: sigma in grey levels. blur: sigma in pixels. exposure_ms: how long each row is exposed;
    its time is the middle of that, and 0 has no motion blur. vignetting: of the light, lost in
    the corners. bonnet, pillar, timestamp: what dashcams see of their own car, and burn in.
    rolling_shutter_ms: from the first row to the last; a frame's time is its middle row's.
    stabilised: how far a stabiliser moves its crop at most, of the width; 0 has none.
    moving_cars: oncoming, leading and crossing ones.
    stops: red lights. night: dark and noisy. flicker: RMS of the exposure's relative variation.
    jpeg_quality: compress as a dashcam would; None does not.
    mounting: of this camera, in the place of height_m and mount_deg; None: made up from the seed.
    kind: 'parked' stands still and 'spin' turns on the spot, both for duration_s.
    """

    rate: float = 10.0
    turns: int | tuple[Turn, ...] = 5
    straight_m: float = 28.0
    lead_m: float = 34.0
    speed_mps: float = 11.0
    turn_speed_mps: float = 5.0
    accel_mps2: float = 2.5
    height_m: float = 1.4
    mount_deg: float = 1.0
    vibration_deg: float = 0.35
    shortest_bump_m: float = 2.5
    seed: int = 0
    noise: float = 1.5
    blur: float = 0.4
    exposure_ms: float = 0.0
    vignetting: float = 0.0
    bonnet: bool = False
    pillar: bool = False
    timestamp: bool = False
    rolling_shutter_ms: float = 0.0
    stabilised: float = 0.0
    moving_cars: int = 0
    stops: tuple[Stop, ...] = ()
    night: bool = False
    flicker: float = 0.01
    jpeg_quality: int | None = None
    mounting: Mounting | None = None
    kind: Kind = 'drive'
    duration_s: float = 10.0

    def __post_init__(self) -> None:
        positive = ('rate', 'straight_m', 'lead_m', 'speed_mps', 'turn_speed_mps',
                    'accel_mps2', 'height_m', 'duration_s', 'shortest_bump_m')
        for name in positive:
            if not getattr(self, name) > 0.0:
                raise ConfigError('E-DRIVE-RANGE', f'a drive needs {name} > 0, not '
                                                   f'{getattr(self, name)!r}')
        for name in ('vibration_deg', 'noise', 'blur', 'exposure_ms', 'vignetting',
                     'rolling_shutter_ms', 'stabilised', 'moving_cars', 'flicker', 'seed'):
            if not getattr(self, name) >= 0:
                raise ConfigError('E-DRIVE-RANGE', f'a drive needs {name} >= 0, not '
                                                   f'{getattr(self, name)!r}')
        if self.exposure_ms + self.rolling_shutter_ms > MAX_FRAME_MS:
            raise ConfigError('E-DRIVE-RANGE', f'a picture is taken within {MAX_FRAME_MS:g} ms: '
                                               f'exposure_ms and rolling_shutter_ms together '
                                               f'must not be longer')
        for name, most in (('vignetting', 1.0), ('stabilised', MAX_STABILISED)):
            if getattr(self, name) > most:
                raise ConfigError('E-DRIVE-RANGE', f'a drive needs {name} <= {most:g}, not '
                                                   f'{getattr(self, name)!r}')
        if any(abs(turn.angle_deg) > 170.0 or turn.radius_m < 4.0 for turn in self.turn_list):
            raise ConfigError('E-DRIVE-RANGE',
                              'a turn needs at most 170 degrees and a radius of 4 m or more')
        for stop in self.stops:
            if not 0 <= stop.before_turn <= len(self.turn_list):
                raise ConfigError('E-DRIVE-RANGE',
                                  f'there is no straight {stop.before_turn} to stop on')

    @property
    def turn_list(self) -> tuple[Turn, ...]:
        """Return the turns, made up from the seed if only their number was given."""
        if not isinstance(self.turns, int):
            return tuple(self.turns)
        rng = np.random.default_rng([self.seed, 1])
        side = 1.0 if rng.random() < 0.5 else -1.0
        return tuple(Turn(side * (-1.0) ** i * float(rng.uniform(60.0, 100.0)),
                          float(rng.uniform(8.0, 14.0))) for i in range(self.turns))
