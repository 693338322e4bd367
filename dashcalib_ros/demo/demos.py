# SPDX-License-Identifier: Apache-2.0
"""The drives of `dashcalib demo`: one for each kind of lens, and for what spoils a calibration."""
from __future__ import annotations

from dataclasses import dataclass, replace

from dashcalib_ros.demo.drive import AnyLens, Drive
from dashcalib_ros.demo.fisheye import FisheyeLens
from dashcalib_ros.demo.glass import Glass
from dashcalib_ros.demo.lens import Lens
from dashcalib_ros.demo.spec import DriveSpec
from dashcalib_ros.errors import ConfigError

RADIAL = Lens.of(960, 540, 75.0, -0.30, 0.10, offset=(14.0, -9.0), aspect=1.003)
# a low bonnet and a burnt-in time stamp, as most dashcams have them
SPEC = DriveSpec(bonnet=True, timestamp=True)


@dataclass(frozen=True)
class Demo:
    """about: what is rendered, and the verdict to expect, unless it is accepted."""

    about: str
    lens: AnyLens = RADIAL
    spec: DriveSpec = SPEC


DEMOS = {
    'radial': Demo('a lens with radial distortion, k1 and k2'),
    'brown': Demo('a decentred lens: p1, p2 and k3 beside k1 and k2',
                  replace(RADIAL, p1=0.003, p2=-0.002, k3=0.03)),
    'fisheye': Demo('a fisheye lens, 130° wide',
                    FisheyeLens.of(960, 540, 130.0, (-0.02, 0.006, -0.003, 0.0005),
                                   (9.0, -7.0), 1.002)),
    'windscreen': Demo('a lens behind a windscreen that bends the picture by 1 px RMS',
                       replace(RADIAL, glass=Glass(1.0, 'windscreen'))),
    'shutter': Demo('a rolling shutter: 25 ms from the first row to the last',
                    spec=replace(SPEC, rolling_shutter_ms=25.0)),
    # a stabiliser would move the bonnet, too
    'stabilised': Demo('a stabilised video, whose crop moves by up to 5 % of the width: no '
                       'calibration holds for all pictures, and the verdict should be weak',
                       spec=replace(SPEC, stabilised=0.05, bonnet=False)),
    'straight': Demo('a drive without turns: no camera can be calibrated from it, and the verdict '
                     'should be refused', spec=replace(SPEC, turns=0, duration_s=20.0))}


def demo_drive(seed: int = 0, lens: str = 'radial') -> Drive:
    """Return a drive of 960 x 540 px at 10 Hz, with five turns as a rule.

    lens: the name of one of DEMOS. Raises ConfigError for another name.
    """
    if lens not in DEMOS:
        raise ConfigError('E-DEMO-UNKNOWN', f'there is no demo {lens!r}: use one of '
                                            f'{", ".join(DEMOS)}')
    demo = DEMOS[lens]
    return Drive(demo.lens, replace(demo.spec, seed=seed))
