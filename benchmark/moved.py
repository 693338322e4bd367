#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""A camera that is moved on the car within a drive: how often it is told, and told for nothing.

    python benchmark/moved.py [--count 100] [--degrees 1.0] [--metres 200] [--results]

Made pairs of images: noise of 0.3 px, a body that nods, streets of 20 to 80 m on each of which
the car's yaw and pitch differ by 0.15 degrees (crowns and slopes), 200 to 800 m of straights; the
camera is moved in a direction drawn at random, and the drive ends METRES later. The whole drive is
asked, as a recorded one is, and its newest pairs again and again, as the node does.
"""
from __future__ import annotations

from dataclasses import replace

import numpy as np
from measure import keep_table, parser_with, table
from solving import scenes_of, solved, with_camera
from straight_pairs import SPACING_S, SPEED, mounted, pairs_of
from synthetic import LENS

from dashcalib_ros.arrays import Floats
from dashcalib_ros.detect.straights import Straights
from dashcalib_ros.judge.mount import mount_of, moved
from dashcalib_ros.ros.background import PAIRS, PAIRS_BETWEEN

NOISE_PX, PLACE_DEG = 0.3, 0.15
STREET_M, BEFORE_M = (20.0, 80.0), (200.0, 800.0)
PAIR_M = SPEED * SPACING_S / 2


def drive(rng: np.random.Generator, metres: float, angles: Floats) -> list[Straights]:
    """Return the straights of some streets; angles: yaw and pitch of the camera, degrees."""
    found, left = [], round(metres / PAIR_M)
    while left > 0:
        count = min(left, round(rng.uniform(*STREET_M) / PAIR_M))
        yaw, pitch = angles + rng.normal(0.0, PLACE_DEG, 2)
        some = pairs_of(mounted(yaw, pitch, 0.0), count=count, noise_px=NOISE_PX,
                        seed=int(rng.integers(2**31)))
        found.append(some)
        left -= count
    return found


def joined(parts: list[Straights]) -> Straights:
    """Return all parts as one drive, a pair each SPACING_S / 2."""
    apart = np.concatenate([each.apart_s for each in parts])
    return Straights(np.concatenate([each.before for each in parts]),
                     np.concatenate([each.after for each in parts]),
                     np.arange(len(apart)) * SPACING_S / 2, apart)


def told_live(pairs: Straights) -> bool:
    """Return whether the node says that the camera was moved."""
    for end in range(PAIRS_BETWEEN, len(pairs) + 1, PAIRS_BETWEEN):
        newest = slice(max(0, end - PAIRS), end)
        if moved(Straights(pairs.before[newest], pairs.after[newest], pairs.stamps_s[newest],
                           pairs.apart_s[newest]), LENS):
            return True
    return False


def main() -> None:
    """Measure."""
    parser = parser_with(__doc__)
    parser.add_argument('--count', type=int, default=100, help='of drives')
    parser.add_argument('--degrees', type=float, default=1.0)
    parser.add_argument('--metres', type=float, default=200.0)
    arguments = parser.parse_args()
    known = replace(with_camera(solved(scenes_of(3)), LENS), scenes=())
    told, place, nothing, live, idle = 0, [], 0, 0, 0
    for seed in range(arguments.count):
        rng = np.random.default_rng(seed)
        angles = rng.uniform(-3.0, 3.0, 2)
        way = rng.uniform(0.0, 2.0 * np.pi)
        turned = angles + arguments.degrees * np.array([np.cos(way), np.sin(way)])
        before = drive(rng, rng.uniform(*BEFORE_M), angles)
        still = drive(rng, arguments.metres, angles)
        after = drive(rng, arguments.metres, turned)
        found, quiet = (mount_of(joined([*before, *then]), None, known, 'accepted', None)
                        for then in (after, still))
        assert found is not None and quiet is not None
        nothing += quiet.moved_s is not None
        live += told_live(joined([*before, *after]))
        idle += told_live(joined([*before, *still]))
        if found.moved_s is not None:
            told += 1
            count = sum(map(len, before)) - 1
            place.append(PAIR_M * abs(found.moved_s / (SPACING_S / 2) - count))
    of = f'of {arguments.count}'
    far = f'{np.median(place or [np.nan]):.0f}, {max(place, default=np.nan):.0f}'
    text = f'{arguments.degrees:g}°, {arguments.metres:g} m after the move.\n\n'
    keep_table('moved', text + table(
        ['', 'recorded drive', 'as the node asks'],
        [['moved: found', f'{told} {of}', f'{live} {of}'],
         ['not moved: found', f'{nothing} {of}', f'{idle} {of}'],
         ['m from the place: median, most', far, '']]), arguments)


if __name__ == '__main__':
    main()
