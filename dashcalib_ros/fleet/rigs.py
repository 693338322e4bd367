# SPDX-License-Identifier: Apache-2.0
"""The rigs of a fleet: where the cameras of one car sit, by the turns that were gathered."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from dashcalib_ros.config import Config
from dashcalib_ros.detect.turn import is_turn
from dashcalib_ros.errors import InputError
from dashcalib_ros.fleet import solved, storage
from dashcalib_ros.fleet.clips import ClipResult, gathered, hash_of
from dashcalib_ros.fleet.manifest import Row
from dashcalib_ros.fleet.tables import camera_folder, folder_name
from dashcalib_ros.formats.rig import parse_rig, placed_cameras, rig_files, rig_json
from dashcalib_ros.judge.calibration import Level
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.rig.live import CLOCKS_S, rig_of_scenes
from dashcalib_ros.rig.placed import best_base
from dashcalib_ros.store.scene_file import DATES_S


@dataclass(frozen=True)
class Member:
    """A camera of a rig. file: has its own result; clips: with what became of them."""

    camera: str
    file: str
    clips: Sequence[tuple[Row, ClipResult]]


def place_rig(name: str, members: Sequence[Member], out: str, config: Config) -> dict[str, Level]:
    """Write the files of a rig to rigs/NAME; return the cameras' verdicts.

    What was solved of the same turns is not solved again. Raises InputError where clips of several
    drives have no times.
    """
    own = {each.camera: solved.decoded(
        storage.read(storage.joined(out, each.file)) or b'', each.file) for each in members}
    key = hash_of([name, [each.file for each in members]])
    kept = storage.joined(out, f'solved/{key[:2]}/{key}-rig.json')
    text = storage.read(kept)
    if text is None:
        levels = {camera: each.calibration.verdict.level for camera, each in own.items()}
        scenes, dated = _scenes(members, out, config)
        found = rig_of_scenes(scenes, levels, best_base(levels), -float('inf'), None, config,
                              CLOCKS_S if dated else float('inf'))
        text = rig_json(replace(found, cameras={
            camera: replace(each, calibration=f'../../{camera_folder(camera)}/result.json')
            for camera, each in found.cameras.items()})).encode()
        storage.write(kept, text)
    rig = parse_rig(text.decode(), kept)
    files, _ = rig_files(rig, placed_cameras(rig, {
        camera: each.calibration for camera, each in own.items()}))
    for file, content in files.items():
        storage.write(storage.joined(out, f'rigs/{folder_name(name)}/{file}'), content.encode())
    return {camera: each.verdict for camera, each in rig.cameras.items()}


def _scenes(members: Sequence[Member], out: str, config: Config
            ) -> tuple[dict[str, list[Scene]], bool]:
    """Return the turns of each camera that others may have seen, and whether stamps are dates."""
    found, dated, drives = dict[str, list[tuple[float, float, Scene]]](), True, 1
    for each in members:
        clips = {row.name: (row, result.file) for row, result in each.clips if result.file}
        turns = found[each.camera] = []
        drives = max(drives, len(clips))
        for row, file in clips.values():
            clip = gathered(out, str(file))
            for turn in clip.turns if clip else ():
                date = 0.0 if turn.stamp_s >= DATES_S else row.time_s or 0.0
                dated &= turn.stamp_s + date >= DATES_S
                tracks = turn.scene.tracks
                if is_turn(turn.prominence):
                    turns.append((turn.stamp_s + date, turn.prominence, replace(
                        turn.scene, tracks=replace(
                            tracks, stamps_ns=tracks.stamps_ns + round(1e9 * date)))))
    if not dated and drives > 1:
        raise InputError('E-RIG-NO-TIMES', 'its clips are of several drives, and have no dates: '
                                           'add the column time')
    chosen = {camera: [turn for turn in turns if not dated or _seen(turn[0], camera, found)]
              for camera, turns in found.items()}
    best = {camera: sorted(turns or found[camera], key=lambda turn: -turn[1])
            for camera, turns in chosen.items()}
    return {camera: [scene for *_, scene in turns[:config.fleet.turns]]
            for camera, turns in best.items()}, dated


def _seen(stamp_s: float, camera: str, found: Mapping[str, Sequence[tuple[float, float, Scene]]]
          ) -> bool:
    """Return whether another camera has a turn at about this time."""
    return any(abs(other - stamp_s) < CLOCKS_S for name, turns in found.items() if name != camera
               for other, *_ in turns)
