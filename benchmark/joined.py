#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""A drive cut into five files: how far its calibration is from that of the whole, in sigmas.

    python benchmark/joined.py [--drives kitti03 NAME ...] [--data DIR] [--cache DIR]
                               [--out DIR] [--results] [--again] [--joints]

kitti03 needs --data; the other names are settings of drives.py, with seed 0. The files are
folders of the drive's pictures, without loss. They are cut between the turns that the whole drive
uses, or in the middle of the first four of these; with so many seconds of images lost at each
cut. 'not told' is one folder in which these images are missing, and the others are numbered anew:
what a loss does that the stamps hide. Rows go to DIR/joined.json as they come.

--joints: instead, every fourth image of each drive is taken as the first of another file, after a
loss of so many seconds, and as followed by an image of quite another place; how often it is said
to go on, where the car moves and where it stands. DIR/joints.md has the table.
"""
from __future__ import annotations

import copy
import json
import math
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from drives import BY_NAME, drive_of, pictures_of
from measure import (
    KEYS,
    calibrate,
    commit,
    complain,
    done,
    isolated,
    keep_table,
    load,
    parser_with,
    save,
    summarised,
    table,
)

from dashcalib_ros import Config, open_frames
from dashcalib_ros.detect import MotionEstimator
from dashcalib_ros.input import Frame

FILES = 5
# where it is cut, s lost at each cut, and whether the files tell that something may be missing
CASES = (('between', 0.0, True), ('inside', 0.0, True), ('between', 0.5, True),
         ('inside', 0.2, True), ('inside', 0.5, True), ('inside', 0.1, False),
         ('inside', 0.2, False))
# s lost at a joint
JOINT_LOSSES = (0.0, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0)
# s; what is so far off shows another place
FAR_S = 6.0
# of the width, from image to image
STANDING_SHARE = 1e-3
DRIVES = ('kitti03', 'dashcam: bonnet, text', 'rolling shutter 20 ms')


def row_of(folders: Sequence[Path], fps: float, truth: Mapping[str, Any]) -> dict[str, Any]:
    """Calibrate a drive of one folder or several; count the cuts at which it goes on."""
    # one folder in a list is a folder
    drive = [str(folder) for folder in folders]
    estimator = MotionEstimator(Config().tracking)
    gaps = sum(motion.after_gap for frame in open_frames(drive, fps=fps)
               if (motion := estimator.push(frame)) is not None)
    result, _ = calibrate(open_frames(drive, fps=fps), Config())
    return {**summarised(result, truth), 'goes_on': len(folders) - 1 - gaps}


def cuts_of(turns: Iterable[tuple[int, bool, Any]], where: str) -> list[int]:
    """Return the four images before which a drive is cut.

    turns: those of the whole by time: each one's centre, and whether it is used.
    """
    centers = [center for center, used, _ in turns if used]
    if where == 'inside':
        return centers[:FILES - 1]
    # the longest ways between two turns; two cuts on one way where there are too few turns
    ways = sorted(pairwise(centers), key=lambda way: way[0] - way[1])[:FILES - 1]
    cuts = [(first + last) // 2 for first, last in ways]
    lacking = FILES - 1 - len(cuts)
    return sorted(cuts + [first + (last - first) // 3 for first, last in ways[:lacking]])


def split(pictures: Sequence[Path], cuts: Sequence[int], lost: int, folder: Path, told: bool
          ) -> list[Path]:
    """Link the pictures into folders; of each but the last, so many are lost at its end.

    told: else into one folder, where they are numbered anew.
    """
    kept = [pictures[first:end - lost * (end != len(pictures))]
            for first, end in pairwise([0, *cuts, len(pictures)])]
    parts = []
    for number, some in enumerate(kept if told else [list(chain(*kept))]):
        part = folder / f'{number}'
        part.mkdir(parents=True)
        for place, picture in enumerate(some):
            name = picture.name if told else f'{place:06}{picture.suffix}'
            (part / name).symlink_to(picture)
        parts.append(part)
    return parts


def pictures_in(name: str, data: Path | None, cache: Path
                ) -> tuple[list[Path], float, dict[str, Any]]:
    """Return a drive's pictures as files, their rate in Hz, and the true camera."""
    if name == 'kitti03':
        assert data is not None, 'kitti03 needs --data'
        truth = json.loads((data / 'kitti03' / 'truth.json').read_text())
        folder = cache / 'kitti03'
        folder.mkdir(parents=True, exist_ok=True)
        for frame in open_frames(data / 'kitti03' / 'bag'):
            cv2.imwrite(str(folder / f'{frame.index:06}.png'), frame.image)
        return sorted(folder.glob('*.png')), 10.0, {key: truth[key] for key in KEYS}
    drive = drive_of(BY_NAME[name], 0)
    folder = pictures_of(drive, cache).folder
    return sorted(folder.glob('*.png')), drive.spec.rate, dict(drive.truth)


def off(row: Mapping[str, Any], whole: Mapping[str, Any]) -> list[str]:
    """Return how far each parameter is from the whole's, in its sigmas."""
    if 'estimate' not in row:
        return [''] * len(KEYS)
    return [f'{abs(row["estimate"][key] - whole["estimate"][key]) / whole["sigma"][key]:.2f}'
            for key in KEYS]


def text_of(rows: Mapping[str, Mapping[str, Any]], names: Sequence[str]) -> str:
    """Return the table."""
    lines = []
    for name in names:
        whole = rows.get(f'{name}, whole', {})
        for where, lost_s, told in CASES:
            row = rows.get(f'{name}, {where} {lost_s} {told}')
            if row is None or 'estimate' not in whole:
                continue
            lines.append([
                name, f'{where} turns', f'{lost_s:g}' + ('' if told else ', not told'),
                f'{row["goes_on"]} of {FILES - 1}' if told and 'goes_on' in row else '',
                row['verdict'], f'{row.get("turns_used", "")} ({whole["turns_used"]})',
                *off(row, whole)])
    return table(['drive', 'cut', 'lost, s', 'goes on', 'verdict', 'turns (whole)', *KEYS], lines)


def joints_of(pictures: Sequence[Path], fps: float) -> dict[tuple[bool, str], list[bool]]:
    """Return what is said at each joint, by whether the car stands there, and what is lost."""
    images = [np.asarray(cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE), np.uint8)
              for picture in pictures]
    rng = np.random.default_rng(0)
    estimator = MotionEstimator(Config().tracking)
    said: dict[tuple[bool, str], list[bool]] = {}
    moved = [math.inf]
    for index, image in enumerate(images):
        def goes_on(later: int, index: int = index) -> bool:
            motion = copy.deepcopy(estimator).push(Frame(
                index, round(index * 1e9 / fps), images[later], perhaps_after_gap=True))
            return motion is not None and not motion.after_gap

        if index % 4 == 0 and index > fps:
            # the body still sways when the wheels stand
            stands = moved[-1] < STANDING_SHARE * image.shape[1]
            for lost_s in JOINT_LOSSES:
                # less than an image cannot be lost
                if 0 < lost_s < 1 / fps:
                    continue
                if (later := index + round(lost_s * fps)) < len(images):
                    said.setdefault((stands, f'{lost_s:g}'), []).append(goes_on(later))
            far = int(rng.integers(len(images)))
            if abs(far - index) > FAR_S * fps:
                said.setdefault((stands, 'elsewhere'), []).append(goes_on(far))
        motion = estimator.push(Frame(index, round(index * 1e9 / fps), image))
        moved += [] if motion is None else [motion.moved_px]
    return said


def joints_text(drives: Mapping[str, Mapping[tuple[bool, str], Sequence[bool]]]) -> str:
    """Return the table: goes on, of how many."""
    head = [*(f'{lost_s:g}' for lost_s in JOINT_LOSSES), 'elsewhere']
    lines = []
    for name, said in drives.items():
        for stands in (False, True):
            found = [said.get((stands, key), []) for key in head]
            if any(found):
                lines.append([name, 'stands' if stands else 'moves',
                              *(f'{sum(each)} of {len(each)}' for each in found)])
    return table(['drive', 'the car', *(f'{key} s' for key in head[:-1]), 'elsewhere'], lines)


def main() -> None:
    """Measure."""
    parser = parser_with(__doc__, 'drives', 'data', 'cache', 'again', drives=DRIVES)
    parser.add_argument('--joints', action='store_true', help='ask at each fourth image, and end')
    arguments = parser.parse_args()
    path = arguments.out / 'joined.json'
    rows = load(path)

    def measured(key: str, *given: Any) -> dict[str, Any]:
        if arguments.again or not done(rows.get(key)):
            outcome = isolated(row_of, *given)
            rows[key] = {'commit': commit(), **(outcome.value or {
                'verdict': 'failed', 'reasons': [outcome.failure]})}
            save(path, rows)
            complain(f'{key}: {rows[key]["verdict"]}')
        return dict(rows[key])

    with tempfile.TemporaryDirectory() as passing:
        cache = arguments.cache or Path(passing)
        if arguments.joints:
            joints = {}
            for name in arguments.drives:
                pictures, fps, _ = pictures_in(name, arguments.data, cache)
                joints[name] = joints_of(pictures, fps)
                complain(joints_text({name: joints[name]}))
            arguments.out.mkdir(parents=True, exist_ok=True)
            (arguments.out / 'joints.md').write_text(joints_text(joints) + '\n')
            return
        for name in arguments.drives:
            pictures, fps, truth = pictures_in(name, arguments.data, cache)
            whole = measured(f'{name}, whole', [pictures[0].parent], fps, truth)
            if whole['verdict'] in ('failed', 'refused'):
                continue
            for where, lost_s, told in CASES:
                key = f'{name}, {where} {lost_s} {told}'
                folders = split(pictures, cuts_of(whole['turns'], where), round(lost_s * fps),
                                Path(passing) / key.replace(' ', '_'), told)
                measured(key, folders, fps, truth)
    keep_table('joined', text_of(rows, arguments.drives), arguments,
               [row['commit'] for row in rows.values()])


if __name__ == '__main__':
    main()
