# SPDX-License-Identifier: Apache-2.0
"""The drives that are measured: settings x seeds, rendered once and kept as pictures."""
from __future__ import annotations

import hashlib
import inspect
import os
import shutil
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

import dashcalib_ros.demo
from dashcalib_ros.demo import Drive, DriveSpec, Lens, Stop, Turn
from dashcalib_ros.demo.drive import AnyLens
from dashcalib_ros.errors import ConfigError
from dashcalib_ros.input import Frame

# what must become of a drive: 'judge' is anything but accepted and wrong
Must = Literal['accept', 'judge', 'refuse']


@dataclass(frozen=True)
class Setting:
    """A lens and a drive, both varied by each seed."""

    name: str
    lens: Lens
    spec: DriveSpec
    must: Must = 'accept'

    @property
    def counts(self) -> bool:
        """Return whether it belongs into the medians: five turns or more, global shutter."""
        return (self.must == 'accept' and len(self.spec.turn_list) >= 5
                and self.spec.rolling_shutter_ms == 0.0)


def bends(radius_m: float, angle_deg: float, count: int = 5) -> tuple[Turn, ...]:
    """Return turns to either side, all alike."""
    return tuple(Turn((-1.0) ** i * angle_deg, radius_m) for i in range(count))


KITTI_RAW = Lens(1392, 512, 960.115, 954.891, 694.792, 240.355, -0.363, 0.151)
DEMO = Lens.of(960, 540, 75.0, -0.30, 0.10, (14.0, -9.0), 1.003)
WIDE = Lens.of(1280, 720, 115.0, -0.22, 0.04, (-20.0, 12.0), 0.998)
WIDEST = Lens.of(960, 540, 120.0, -0.20, 0.03, (8.0, 10.0), 1.002)
NARROW = Lens.of(1280, 720, 48.0, 0.08, 0.05, (10.0, 20.0))
TELE = Lens.of(960, 540, 40.0, 0.15, -0.20, (-12.0, 6.0), 0.995)
VGA = Lens.of(640, 480, 65.0, -0.35, 0.12, (6.0, 5.0), 1.01)
SHIFTED = Lens.of(960, 540, 85.0, -0.26, 0.07, (-42.0, 30.0), 0.993)
PINHOLE = Lens.of(960, 540, 80.0, 0.0, 0.0, (5.0, -4.0), 1.0)
FULL_HD = Lens.of(1920, 1080, 90.0, -0.28, 0.07, (25.0, -15.0), 1.001)

STREET = DriveSpec()
NOTHING: Must = 'refuse'
MOTORWAY = DriveSpec(turns=bends(350.0, 10.0), straight_m=60.0, lead_m=80.0, speed_mps=27.0,
                     turn_speed_mps=27.0)

# in the order in which they run: what decides most comes first
SETTINGS = (
    Setting('KITTI raw lens, 1392x512', KITTI_RAW, STREET),
    Setting('dashcam: bonnet, text', DEMO, replace(STREET, bonnet=True, timestamp=True)),
    Setting('rolling shutter 20 ms', DEMO, replace(STREET, rolling_shutter_ms=20.0), 'judge'),
    Setting('48 deg, pincushion', NARROW, STREET),
    Setting('115 deg, bonnet, pillar, text', WIDE,
            replace(STREET, bonnet=True, pillar=True, timestamp=True)),
    Setting('640x480, fy/fx 1.01, noise 3', VGA, replace(STREET, noise=3.0)),
    Setting('3 fps', DEMO, replace(STREET, rate=3.0)),
    Setting('8 moving cars', DEMO, replace(STREET, moving_cars=8)),
    Setting('one turn', DEMO, replace(STREET, turns=1), 'judge'),
    Setting('straight on', DEMO, replace(STREET, turns=0, duration_s=20.0), NOTHING),
    Setting('parked', DEMO, replace(STREET, kind='parked', duration_s=12.0), NOTHING),
    Setting('at a light, others moving', DEMO,
            replace(STREET, turns=0, duration_s=8.0, moving_cars=8, stops=(Stop(0, 12.0),)),
            NOTHING),
    Setting('parked at night', DEMO, replace(STREET, kind='parked', night=True, duration_s=12.0),
            NOTHING),
    Setting('turning on the spot', DEMO, replace(STREET, kind='spin', duration_s=20.0), NOTHING),
    Setting('motorway bends', DEMO, MOTORWAY, 'judge'),
    Setting('off-centre, fy/fx 0.993', SHIFTED, STREET),
    Setting('noise 6, blur 1', DEMO, replace(STREET, noise=6.0, blur=1.0)),
    Setting('exposure 10 ms', DEMO, replace(STREET, exposure_ms=10.0)),
    Setting('JPEG 40', DEMO, replace(STREET, jpeg_quality=40)),
    Setting('40 deg, pincushion', TELE, STREET),
    Setting('120 deg', WIDEST, STREET),
    Setting('radius 25 m', DEMO, replace(STREET, turns=bends(25.0, 80.0), turn_speed_mps=7.0)),
    Setting('no distortion', PINHOLE, STREET),
    Setting('rolling shutter 10 ms', DEMO, replace(STREET, rolling_shutter_ms=10.0), 'judge'),
    Setting('rolling shutter 30 ms', DEMO, replace(STREET, rolling_shutter_ms=30.0), 'judge'),
    Setting('two turns', DEMO, replace(STREET, turns=2), 'judge'),
    Setting('1920x1080', FULL_HD, STREET),
    Setting('30 fps, two turns, 640x480', VGA, replace(STREET, rate=30.0, turns=2), 'judge'),
    Setting('everything at once', WIDE,
            replace(STREET, bonnet=True, pillar=True, timestamp=True, noise=3.0, blur=0.8,
                    moving_cars=6, jpeg_quality=60, rolling_shutter_ms=10.0, vignetting=0.5),
            'judge'),
    Setting('eight turns', DEMO, replace(STREET, turns=8)),
    Setting('night, driving', DEMO, replace(STREET, night=True), 'judge'),
)
BY_NAME = {setting.name: setting for setting in SETTINGS}


def drive_of(setting: Setting, seed: int) -> Drive:
    """Return the drive of a seed: its own street, turns, noise, and its own lens.

    Settings share no street even for the same seed, so that there are as many as drives.
    """
    own = zlib.crc32(f'{setting.name} {seed}'.encode())
    return Drive(_varied(setting.lens, own), replace(setting.spec, seed=own))


def _varied(lens: Lens, seed: int) -> Lens:
    """Return a lens like this one: nothing shall be tuned to a single one.

    f by up to 10 %, the centre by 1.5 % of the size, each k by 20 %; drawn anew if that folds.
    """
    rng = np.random.default_rng([seed, 7])
    while True:
        scale, x, y, k1, k2 = rng.uniform(-1.0, 1.0, 5)
        size = 1.0 + 0.1 * scale
        try:
            return replace(
                lens, fx=lens.fx * size, fy=lens.fy * size, cx=lens.cx + 0.015 * lens.width * x,
                cy=lens.cy + 0.015 * lens.height * y, k1=lens.k1 * (1.0 + 0.2 * k1),
                k2=lens.k2 * (1.0 + 0.2 * k2))
        except ConfigError:
            continue


@dataclass(frozen=True)
class Pictures:
    """A rendered drive on disk: 000000.png ... in a folder, stamped as the drive stamps them."""

    folder: Path
    drive: tuple[AnyLens, DriveSpec]

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames in order."""
        drive = Drive(*self.drive)
        for index in range(len(drive)):
            picture = cv2.imread(str(self.folder / f'{index:06}.png'), cv2.IMREAD_GRAYSCALE)
            assert picture is not None
            yield Frame(index, drive.stamp_ns(index), np.asarray(picture, np.uint8))


def pictures_of(drive: Drive, cache: Path) -> Pictures:
    """Render a drive into a folder of the cache, unless this code has done so before."""
    folder = cache / _key(drive)
    if not folder.is_dir():
        making = folder.with_suffix('.new')
        shutil.rmtree(making, ignore_errors=True)
        making.mkdir(parents=True)
        for frame in drive.frames(processes=os.cpu_count() or 1):
            # lossless, and hardly smaller with more effort: noise does not compress
            cv2.imwrite(str(making / f'{frame.index:06}.png'), frame.image,
                        [cv2.IMWRITE_PNG_COMPRESSION, 1])
        making.rename(folder)
    return Pictures(folder, (drive.lens, drive.spec))


def _key(drive: Drive) -> str:
    """Return a name for what these pictures depend on: lens, spec and the code that renders."""
    digest = hashlib.sha256(repr((drive.lens, drive.spec)).encode())
    demo = Path(dashcalib_ros.demo.__file__).parent.glob('*.py')
    for path in sorted({*demo, Path(inspect.getfile(type(drive)))}):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]
