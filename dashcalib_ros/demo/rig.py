# SPDX-License-Identifier: Apache-2.0
"""Rendered drives of several cameras of one car, with the truth about where each sits."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera.rotation import rotation_vectors
from dashcalib_ros.demo.drive import AnyLens, Drive
from dashcalib_ros.demo.fisheye import FisheyeLens
from dashcalib_ros.demo.lens import Lens
from dashcalib_ros.demo.spec import DriveSpec, Mounting
from dashcalib_ros.errors import ConfigError

SIZE = (640, 400)
FRONT = Lens.of(*SIZE, 75.0, -0.25, 0.08, offset=(6.0, -4.0), aspect=1.0)
OTHER = Lens.of(*SIZE, 85.0, -0.28, 0.09, offset=(-5.0, 5.0), aspect=1.0)
SPEC = DriveSpec(shortest_bump_m=5.0)
AHEAD = Mounting(0.6, -1.0, 0.4, 1.7, 0.1, 1.4)


@dataclass(frozen=True)
class RigCamera:
    """One camera of a rig."""

    lens: AnyLens
    mounting: Mounting
    rate: float = 10.0
    rolling_shutter_ms: float = 0.0


# by the names of rigs
RIGS: Mapping[str, Mapping[str, RigCamera]] = {
    'front-left-rear': {
        'front': RigCamera(FRONT, AHEAD),
        'left': RigCamera(OTHER, Mounting(78.0, -4.0, 1.5, 1.2, 0.9, 1.1, 0.03)),
        'rear': RigCamera(OTHER, Mounting(178.5, -3.0, -0.8, -0.9, -0.1, 1.2, 0.06, 0.4, 50.0))},
    'front-rear': {
        'front': RigCamera(FRONT, AHEAD),
        'rear': RigCamera(OTHER, Mounting(178.5, -3.0, -0.8, -0.9, -0.1, 1.2, 0.04, 0.3))},
    'front-left-right': {
        'front': RigCamera(FRONT, AHEAD),
        'left': RigCamera(OTHER, Mounting(70.0, -4.0, 1.5, 1.2, 0.9, 1.1)),
        'right': RigCamera(OTHER, Mounting(-72.0, -3.0, -1.2, 1.2, -0.9, 1.1))},
    'stereo': {
        'left': RigCamera(FRONT, replace(AHEAD, left_m=0.25)),
        'right': RigCamera(replace(FRONT, cx=FRONT.cx + 4), replace(
            AHEAD, yaw_left_deg=0.1, pitch_up_deg=-0.6, roll_right_deg=-0.5, left_m=-0.25))},
    'mixed': {
        'front': RigCamera(FRONT, AHEAD),
        'side': RigCamera(
            FisheyeLens.of(640, 480, 130.0, (-0.02, 0.006, -0.003, 0.0005), (5.0, -4.0), 1.0),
            Mounting(62.0, -8.0, 2.0, 1.4, 0.9, 1.0, 0.02, 1.3, 50.0), 15.0),
        'rear': RigCamera(Lens.of(512, 384, 90.0, -0.28, 0.09),
                          Mounting(-178.0, -3.0, 1.0, -1.0, 0.05, 1.2, 0.05), 12.5, 15.0)}}


def rig_drives(kind: str = 'front-left-rear', seed: int = 0, spec: DriveSpec = SPEC
               ) -> dict[str, Drive]:
    """Return the drives of a rig's cameras: one car, one road. Raises ConfigError."""
    if kind not in RIGS:
        raise ConfigError('E-DEMO-RIG-UNKNOWN', f'there is no rig {kind!r}: use one of '
                                                f'{", ".join(RIGS)}')
    return {name: Drive(camera.lens, replace(
        spec, seed=seed, rate=camera.rate, mounting=camera.mounting,
        rolling_shutter_ms=camera.rolling_shutter_ms)) for name, camera in RIGS[kind].items()}


@dataclass(frozen=True)
class TruePlace:
    """Where a camera sits against the base, as rig.json has it."""

    rotation: Floats
    translation_m: Floats
    time_offset_s: float

    @property
    def values(self) -> dict[str, object]:
        """Return what truth.json says about it."""
        return {'rotation_deg': np.degrees(rotation_vectors(self.rotation[None])[0]).tolist(),
                'translation_m': self.translation_m.tolist(),
                'time_offset_s': self.time_offset_s}


def true_places(drives: Mapping[str, Drive], base: str) -> dict[str, TruePlace]:
    """Return where each camera sits; the time offset is that of the middle of the drive."""
    first = drives[base]
    found = {}
    for name, drive in drives.items():
        rotation = drive.ride.mount.T @ first.ride.mount
        shift = drive.ride.mount.T @ (first.ride.lever - drive.ride.lever)
        middle = first.ride.duration / 2
        found[name] = TruePlace(rotation, shift, _stamp(drive, middle) - _stamp(first, middle))
    return found


def _stamp(drive: Drive, time: float) -> float:
    """Return a camera's stamp of a time, without the part that all have."""
    own = drive.spec.mounting or Mounting()
    return own.late_s + (time - own.phase_s) * (1 + 1e-6 * own.clock_ppm)
