#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""The true motion of a drive beside what cameras find: over its turns, and over all of it.

    python benchmark/poses.py [DRIVE POSES --camera NAME=FILE ...] [--data DIR] [--out DIR]
                              [--results] [--windows N] [--no-turns]

DRIVE: what dashcalib run reads; POSES: KITTI's format, one line for each frame; FILE: what
dashcalib compare reads. A trivial guess (f is the width, the centre in the middle, no distortion)
and the drive's own result are always among them.

Over the turns each scene of the calibration is adjusted anew with each camera held, as dashcalib
check --poses does it. Over the whole drive, windows of WINDOW frames every STEP frames are tracked
once, and chained and adjusted with each camera held. Their rotations are multiplied; their scales
are tied where two windows overlap. A window that a camera cannot chain is left out for all of
them; the trivial guess chains the fewest, and counts for itself. Rows go to DIR/poses.json after
each window, tables to DIR/poses.md, the plot of the whole drive to DIR/drive.svg.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from measure import complain, keep_table, load, parser_with, save, table

from dashcalib_ros import Calibrator, Config, open_frames
from dashcalib_ros.camera import Camera
from dashcalib_ros.detect import Turn, TurnId
from dashcalib_ros.formats import load_camera
from dashcalib_ros.input import Frame
from dashcalib_ros.input.poses import Poses, read_poses
from dashcalib_ros.judge import trivial_guess
from dashcalib_ros.judge.odometry import TurnPath as TruePath
from dashcalib_ros.judge.odometry import angle_deg, length, odometry, path_files
from dashcalib_ros.problem.observations import Structure, Tracks
from dashcalib_ros.reconstruct.chain import chain_scene
from dashcalib_ros.reconstruct.scene import Profile, Scene
from dashcalib_ros.reconstruct.tracks import track_turn
from dashcalib_ros.solve.start import scene_with

# frames of a window, from one to the next, and between two keyframes
WINDOW, STEP, STRIDE = 43, 30, 3
TRACKS = 500
NO_PROFILE = Profile(np.zeros(0), np.zeros(0), 0)
GUESS = 'trivial guess'


def window_tracks(frames: Sequence[Frame], config: Config) -> Tracks:
    """Return a window's tracks in each STRIDE-th frame, those that are seen in the most."""
    every = config.replace({'tracks.keyframe_motion': 0.0})
    turn = Turn(frames[0].index, frames[0].index, frames[-1].index, 0.0, 0.0, tuple(frames))
    tracks = track_turn(turn, every.tracks)
    rows = np.flatnonzero((tracks.frames - frames[0].index) % STRIDE == 0)
    xy = tracks.xy[rows]
    seen = np.isfinite(xy[:, :, 0]).sum(axis=0)
    best = np.sort(np.argsort(-seen, kind='stable')[:TRACKS])
    best = best[seen[best] >= 3]
    return Tracks(tracks.frames[rows], xy[:, best], tracks.image_size, tracks.stamps_ns[rows])


def window_path(tracks: Tracks, camera: Camera, config: Config) -> TruePath | None:
    """Return where the camera was in each keyframe; None where it does not explain all of them."""
    scene: Scene | None = chain_scene(tracks, TurnId.at(0), camera, NO_PROFILE, config)
    scene = None if scene is None else scene_with(camera, scene, config)
    if scene is None or not scene.structure.registered.all():
        return None
    return path_of(scene.structure)


def path_of(structure: Structure) -> TruePath:
    """Return the poses of a structure, to the world."""
    turned = structure.rotations.transpose(0, 2, 1)
    return TruePath(turned, -np.einsum('kij,kj->ki', turned, structure.translations))


def windows(frames: Sequence[Frame], cameras: Mapping[str, Camera], config: Config,
            known: dict[str, Any], path: Path, most: int | None) -> None:
    """Add each window's path with each camera to what is known, as lists."""
    starts = range(0, len(frames) - WINDOW + 1, STEP)
    for start in list(starts)[:most]:
        rows = known.setdefault(str(start), {})
        missing = [name for name in cameras if name not in rows]
        if not missing:
            continue
        tracks = window_tracks(frames[start:start + WINDOW], config)
        for name in missing:
            found = window_path(tracks, cameras[name], config)
            rows[name] = None if found is None else {
                'rotations': found.rotations.tolist(), 'positions': found.positions.tolist()}
        save(path, known)
        complain(f'window {start}: ' + ', '.join(
            f'{name} {"" if rows[name] else "none"}' for name in cameras))


def chained(known: Mapping[str, Any], poses: Poses, names: Sequence[str]
            ) -> dict[str, dict[str, Any]]:
    """Return each camera's drift over the windows that all of them explain."""
    starts = sorted(int(start) for start, rows in known.items()
                    if all(rows.get(name) for name in names))
    step, keyframes = STEP // STRIDE, WINDOW // STRIDE + 1
    found: dict[str, dict[str, Any]] = {}
    for name in names:
        missed, scales, total, truth, places = [], [], np.eye(3), np.eye(3), []
        metres, scale, before = 0.0, 1.0, None
        position = np.zeros(3)
        for start in starts:
            frames = start + STRIDE * np.arange(keyframes)
            true_rotations, true_positions = poses.rotations[frames], poses.positions[frames]
            own = TruePath(*(np.array(known[str(start)][name][key])
                             for key in ('rotations', 'positions')))
            if before is not None and start - before[0] == STEP:
                # as long as the window before says about the frames that both have
                shared = slice(step, keyframes)
                scale *= (length(before[1].positions[shared])
                          / length(own.positions[:keyframes - step]))
            elif before is not None:
                # a gap: there the scale is as true as it was before
                scale = scales[-1] * (length(true_positions[:step + 1])
                                      / length(own.positions[:step + 1]))
            else:
                scale = length(true_positions[:step + 1]) / length(own.positions[:step + 1])
            part = own.rotations[0].T @ own.rotations[step]
            true = true_rotations[0].T @ true_rotations[step]
            missed.append(abs(angle_deg(np.array([np.eye(3), part]))
                              - angle_deg(np.array([np.eye(3), true]))))
            local = (own.positions[:step + 1] - own.positions[0]) @ own.rotations[0]
            places += (position + scale * local[:-1] @ total.T).tolist()
            position = position + scale * total @ local[-1]
            total, truth = total @ part, truth @ true
            driven = length(true_positions[:step + 1])
            scales.append(scale * length(own.positions[:step + 1]) / driven)
            metres += driven
            before = (start, own)
        off = angle_deg(np.array([np.eye(3), truth.T @ total]))
        scales_found = np.array(scales) / scales[0]
        found[name] = {
            'windows': len(starts), 'metres': metres, 'rotation_deg_per_100m': 100 * off / metres,
            'rotation_deg': off, 'window_deg': float(np.sqrt(np.mean(np.square(missed)))),
            'scale_drift_percent': 100 * float(scales_found[-1] - 1),
            'scale_spread_percent': 100 * float(np.std(np.log(scales_found))),
            'places': places}
    return found


COLOURS = ('#d62728', '#1f77b4', '#7f7f7f', '#2ca02c', '#9467bd')


def drive_svg(found: Mapping[str, Mapping[str, Any]], true: np.ndarray) -> str:
    """Return the whole drive from above: the true path, and each camera's from the same start."""
    width = 640
    flat = {'GPS/IMU': true[:, [0, 2]],
            **{name: np.array(row['places'])[:, [0, 2]] for name, row in found.items()}}
    low = np.min([path.min(axis=0) for path in flat.values()], axis=0)
    high = np.max([path.max(axis=0) for path in flat.values()], axis=0)
    scale = (width - 60) / float(high[0] - low[0])
    height = 60 + scale * float(high[1] - low[1])
    lines = ''
    for n, (name, path) in enumerate(flat.items()):
        colour = ('black', *COLOURS)[n]
        points = ' '.join(f'{x:.1f},{height - z:.1f}' for x, z in 30 + scale * (path - low))
        lines += (f'<polyline fill="none" stroke="{colour}" stroke-width="{3 if n == 0 else 1.5}" '
                  f'points="{points}"/><text x="30" y="{24 + 20 * n}" fill="{colour}">'
                  f'{name}</text>')
    return (f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height:.0f}" '
            f'font-family="sans-serif" font-size="14"><rect width="100%" height="100%" '
            f'fill="white"/>{lines}</svg>\n')


def main() -> None:
    """Measure."""
    parser = parser_with(__doc__, 'data')
    parser.add_argument('drive', nargs='?', help="default: KITTI 03 in --data, with KITTI's K")
    parser.add_argument('poses', nargs='?', type=Path)
    parser.add_argument('--camera', action='append', default=[], metavar='NAME=FILE')
    parser.add_argument('--windows', type=int, help='how many, at the most')
    parser.add_argument('--no-turns', action='store_true', help='only the whole drive')
    arguments = parser.parse_args()
    config, kitti = Config(), (arguments.data or Path('data')) / 'kitti03'
    drive = arguments.drive or kitti / 'bag'
    poses = read_poses(arguments.poses or kitti / 'poses.txt')
    given = dict(each.split('=', 1) for each in arguments.camera) or {
        "KITTI's K": str(kitti / 'truth.json')}
    cameras = {name: load_camera(path).camera for name, path in given.items()}
    cameras[GUESS] = trivial_guess(next(iter(cameras.values())).image_size)
    arguments.out.mkdir(parents=True, exist_ok=True)
    lines = []
    if not arguments.no_turns:
        with Calibrator(config) as calibrator:
            for frame in open_frames(drive):
                calibrator.push(frame)
            found_camera = calibrator.calibrate().camera
            solution = calibrator.solution
        assert solution is not None and found_camera is not None
        cameras['ours'] = found_camera
        found = odometry(solution.scenes, cameras, poses, config)
        for name, text in path_files(found).items():
            (arguments.out / name).write_text(text)
        medians = found.medians()
        lines.append(table(['camera', *(f'frame {turn.turn.number}: {turn.angle_deg:.0f}°'
                                        for turn in found.turns), 'median °', '° in 100 m',
                            'scale %'], [
            [name, *(f'{turn.rotation_deg(name):.2f}' for turn in found.turns),
             *(f'{unit * medians[key][name]:.2f}' for key, unit in (
                 ('rotation_deg', 1), ('rotation_deg_per_100m', 1), ('scale_drift', 100)))]
            for name in cameras]))
    frames = list(open_frames(drive))
    own = [name for name in cameras if name != GUESS]
    path = arguments.out / 'poses.json'
    known = load(path)
    windows(frames, cameras, config, known, path, arguments.windows)
    drifts = {**chained(known, poses, own), **chained(known, poses, [GUESS])}
    lines.append(table(
        ['camera', 'windows', 'm', 'rotation off at the end °', '° in 100 m', 'RMS of a window °',
         'scale at the end %', 'scale spread %'],
        [[name, str(row['windows']), f'{row["metres"]:.0f}', *(f'{row[key]:.2f}' for key in (
            'rotation_deg', 'rotation_deg_per_100m', 'window_deg', 'scale_drift_percent',
            'scale_spread_percent'))] for name, row in drifts.items()]))
    # the guess leaves the plot
    (arguments.out / 'drive.svg').write_text(drive_svg(
        {name: drifts[name] for name in own}, poses.positions))
    keep_table('poses', '\n\n'.join(lines), arguments)


if __name__ == '__main__':
    main()
