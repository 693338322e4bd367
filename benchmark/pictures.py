#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Draw the pictures of README.md and docs/ from the demo drive.

    python benchmark/pictures.py [--only plots|report]

plots: those in docs/plots/, and docs/picture.png; needs matplotlib. report: docs/report.png, the
page that `dashcalib demo` writes, as Chromium shows it. Default: both, two minutes on two cores.
"""
from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import matplotlib
import numpy as np

from dashcalib_ros import Config
from dashcalib_ros.arrays import Floats, GreyImage
from dashcalib_ros.camera import ros_camera
from dashcalib_ros.camera.mapping import sensitivity
from dashcalib_ros.demo import demo_drive
from dashcalib_ros.detect.detection import detect
from dashcalib_ros.detect.epipoles import epipoles_of
from dashcalib_ros.judge import CalibrationData
from dashcalib_ros.judge.conclude import conclude, evidence_of_detection
from dashcalib_ros.reconstruct import reconstruct
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.solve import solve
from dashcalib_ros.solve.solution import Solution
from dashcalib_ros.solve.start import summed

matplotlib.use('agg')
matplotlib.rcParams['font.size'] = 9
import matplotlib.pyplot as plt  # noqa: E402 (after the choice of the backend)

DOCS = Path(__file__).resolve().parents[1] / 'docs'
PLOTS = DOCS / 'plots'
# of the pair of pictures: a frame with a line across the road, its ends in the undistorted
# picture in px, and how much of that picture is shown
FRAME, ENDS, SHOWN = 314, ((14.0, 466.0), (944.0, 428.0)), (slice(62, 500), slice(5, 955))
# images between the two of a pair whose epipoles are drawn: 0.3 s
SPACING = 3
# the window in which the report is shown, px
WINDOW = (1040, 1080)
BROWSER = ('--headless', '--no-sandbox', '--disable-gpu', '--disable-quic', '--no-first-run',
           '--disable-background-networking', '--disable-component-update', '--disable-sync',
           '--hide-scrollbars', f'--window-size={WINDOW[0]},{WINDOW[1]}')


@dataclass(frozen=True)
class Measured:
    """All that is drawn. epipoles: (n, 2) x of each pair's two, of the image width."""

    images: list[GreyImage]
    stamps_s: Floats
    yaw: Floats
    truth: dict[str, float]
    epipoles: Floats
    scenes: list[Scene]
    solution: Solution
    calibration: CalibrationData


def measure() -> Measured:
    """Render the demo drive and calibrate it, stage by stage."""
    drive, config = demo_drive(), Config()
    frames = list(drive.frames(processes=os.cpu_count() or 1))
    detection = detect(frames, config)
    scenes = [scene for turn in detection.turns()
              if (scene := reconstruct(turn, config, detection.valid())) is not None]
    solution = solve(scenes, config)
    assert solution is not None
    calibration = conclude(solution, evidence_of_detection(detection, scenes), config)
    images = [frame.image for frame in frames]
    return Measured(images, np.array([(frame.stamp_ns - frames[0].stamp_ns) / 1e9
                                      for frame in frames]),
                    drive.yaw, drive.truth, _epipoles(images), scenes, solution, calibration)


def _epipoles(images: list[GreyImage]) -> Floats:
    """Return (n, 2): where each pair's two epipoles are, from left to right; NaN: not found."""
    found = np.full((len(images), 2), np.nan)
    for n in range(len(images) - SPACING):
        first = cv2.goodFeaturesToTrack(images[n], 400, 0.01, 8)
        second, good, _ = cv2.calcOpticalFlowPyrLK(images[n], images[n + SPACING], first,
                                                   first.copy())
        kept = good[:, 0] > 0
        ends = epipoles_of(first[kept, 0], second[kept, 0], images[n].shape[::-1], 1.0)
        if ends is not None:
            found[n + SPACING // 2] = ends[:, 0]
    return found


def pair(seen: Measured) -> None:
    """Draw a picture of the drive before and after, with a ruler along a straight line."""
    camera = seen.calibration.camera
    assert camera is not None
    # as image_proc does with what `--set rectified=all` writes: nothing is cut off
    whole = np.array(ros_camera(camera, 'all').p).reshape(3, 4)[:, :3]
    maps = cv2.initUndistortRectifyMap(camera.matrix, np.array(camera.ros_distortion()), None,
                                       whole, camera.image_size, cv2.CV_32FC1)
    before, after = seen.images[FRAME], cv2.remap(seen.images[FRAME], *maps, cv2.INTER_LANCZOS4)
    ends = np.array(ENDS)
    rays = np.column_stack([ends, np.ones(2)]) @ np.linalg.inv(whole).T
    figure, panels = plt.subplots(1, 2, figsize=(12, 3.45), layout='constrained')
    for panel, image, line, title in (
            (panels[0], before, camera.project(rays), 'as recorded: straight lines are bent'),
            (panels[1], after, ends, 'with the camera that was found: they are straight')):
        panel.imshow(image, cmap='gray', vmin=0, vmax=255)
        panel.plot(*line.T, color='tab:red', lw=1.4, ls=(0, (6, 3)))
        panel.set_title(title)
        panel.set_axis_off()
    rows, columns = SHOWN
    panels[1].set(xlim=(columns.start, columns.stop), ylim=(rows.stop, rows.start))
    panels[0].set(xlim=(0, before.shape[1]), ylim=(before.shape[0] - 20, 78))
    figure.savefig(DOCS / 'picture.png', dpi=80)
    plt.close(figure)
    _shrink(DOCS / 'picture.png')


def _shrink(path: Path) -> None:
    """Write a picture anew, as small as it can be: it is in every clone."""
    picture = cv2.imread(str(path))
    assert picture is not None
    cv2.imwrite(str(path), picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])


def report() -> None:
    """Take the picture of the page that `dashcalib demo` writes."""
    browser = shutil.which('chromium') or shutil.which('google-chrome')
    if browser is None:
        sys.exit('the picture of the report needs Chromium; install it')
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / 'demo' / 'report.html'
        subprocess.run([sys.executable, '-m', 'dashcalib_ros', 'demo', '--quiet', '--out',
                        str(page.parent)], check=True)
        subprocess.run([browser, *BROWSER, f'--user-data-dir={folder}/profile',
                        f'--screenshot={DOCS / "report.png"}', page.as_uri()], check=True)
    _shrink(DOCS / 'report.png')


def turns(seen: Measured) -> None:
    """Draw the epipoles, the turning magnitude and the true yaw rate over the drive."""
    figure, (top, middle, bottom) = plt.subplots(3, 1, figsize=(8, 6), sharex=True,
                                                 layout='constrained')
    top.plot(seen.stamps_s, 100 * seen.epipoles, '.', ms=3,
             label=('in the first picture of a pair', 'in the second'))
    top.set(ylabel="epipoles' x from the\ncentre, % of the width", ylim=(-30, 30))
    top.legend(loc='lower right', ncols=2, fontsize=8)
    magnitudes = seen.calibration.magnitudes
    assert magnitudes is not None
    middle.plot(magnitudes[:, 0] - magnitudes[0, 0] + _begin(seen), 100 * magnitudes[:, 1], 'k')
    middle.set_ylabel('turning magnitude,\n% of the width')
    bottom.plot(seen.stamps_s, np.abs(np.degrees(np.gradient(seen.yaw, seen.stamps_s))), 'C2')
    bottom.set(ylabel='true yaw rate, °/s', xlabel='s since the start')
    for turn in seen.calibration.turns:
        for panel in (top, middle, bottom):
            panel.axvspan(seen.stamps_s[turn.first], seen.stamps_s[turn.last], color='tab:green',
                          alpha=0.2, lw=0)
    _save(figure, 'turns')


def _begin(seen: Measured) -> float:
    """Return when the first magnitude is, in s since the start."""
    assert seen.calibration.magnitudes is not None
    first = seen.calibration.turns[0]
    return float(seen.calibration.magnitudes[0, 0] - first.stamp_s
                 + seen.stamps_s[first.center])


def profile(seen: Measured) -> None:
    """Draw the focal profile of each turn, and their sum."""
    figure, panel = plt.subplots(figsize=(7, 3.6), layout='constrained')
    for number, scene in enumerate(_in_order(seen), 1):
        panel.plot(scene.profile.ratios, scene.profile.costs, '.-', lw=0.8,
                   label=f'turn {number}, {scene.yaw_deg:.0f}°')
    together = summed([scene.profile for scene in seen.scenes])
    panel.plot(together.ratios, together.costs, 'k', lw=2, label='all turns')
    panel.axvline(seen.truth['fx'] / seen.calibration.image_size[0], color='tab:red', ls='--',
                  lw=1, label='truth')
    panel.set(xlabel='focal length held fixed, of the image width', xscale='log',
              ylabel='cost, px² per observation')
    panel.xaxis.set_major_formatter('{x:.2f}')
    panel.xaxis.set_minor_formatter('{x:.2f}')
    panel.legend(fontsize=8)
    _save(figure, 'profile')


def _in_order(seen: Measured) -> list[Scene]:
    """Return the scenes in the order of their turns."""
    centers = {turn.id: turn.center for turn in seen.calibration.turns}
    return sorted(seen.scenes, key=lambda scene: centers[scene.turn])


def sigma(seen: Measured) -> None:
    """Draw the standard deviation of the picture's points, by the parameters' covariance."""
    camera = seen.solution.camera
    moves, pixels = sensitivity(camera)
    variances = np.einsum('mai,ij,maj->m', moves, seen.solution.covariance, moves)
    figure, panel = plt.subplots(figsize=(6.5, 3.6), layout='constrained')
    shown = panel.tricontourf(*pixels.T, np.sqrt(variances), levels=12, cmap='viridis')
    figure.colorbar(shown, label='sigma, px')
    panel.set(aspect='equal', xlabel='x, px', ylabel='y, px')
    panel.invert_yaxis()
    _save(figure, 'sigma')


def _save(figure: plt.Figure, name: str) -> None:
    # without the version of matplotlib: the same data gives the same file
    figure.savefig(PLOTS / f'{name}.png', dpi=110, metadata={'Software': None})
    plt.close(figure)


def mount() -> None:
    """Draw what the angles of the mounting mean; nothing is measured."""
    figure, panels = plt.subplots(1, 3, figsize=(9, 2.6), layout='constrained')
    side = np.array([(0, .3), (.1, .75), (1.1, .85), (1.7, 1.4), (3, 1.4), (3.6, .85), (4.2, .7),
                     (4.3, .3), (0, .3)])
    above = np.array([(0, -.8), (4, -.8), (4.3, -.5), (4.3, .5), (4, .8), (0, .8), (0, -.8)])
    behind = np.array([(-.9, .3), (-.9, .9), (-.7, 1.4), (.7, 1.4), (.9, .9), (.9, .3), (-.9, .3)])
    for panel, outline, place, degrees, words in (
            (panels[0], above, (3.0, 0.0), 20, 'yaw to the left (from above)'),
            (panels[1], side, (3.05, 1.3), 15, 'pitch upwards; height (from the side)'),
            (panels[2], behind, (0.0, 1.25), -15, 'roll to the right (from behind)')):
        panel.plot(*outline.T, color='0.6')
        reach, turned = 1.9 if panel is not panels[2] else 0.8, np.radians(degrees)
        for angle, style in ((0.0, '--'), (turned, '-')):
            ends = np.array([0.0 if panel is not panels[2] else -reach, reach])
            panel.plot(place[0] + ends * np.cos(angle), place[1] + ends * np.sin(angle), style,
                       color='tab:blue' if style == '-' else '0.4')
        panel.plot(*place, 'o', color='tab:orange')
        panel.set_title(words)
        panel.set_aspect('equal')
        panel.axis('off')
    panels[1].plot((0, 5), (0, 0), color='0.4')
    panels[1].annotate('', (2.7, 0), (2.7, 1.3), arrowprops={'arrowstyle': '<->'})
    panels[0].text(4.4, -0.3, 'direction of travel', color='0.4')
    _save(figure, 'mount')


def main() -> None:
    """Measure and draw."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--only', choices=('plots', 'report'))
    only = parser.parse_args().only
    if only != 'report':
        PLOTS.mkdir(exist_ok=True)
        mount()
        seen = measure()
        for draw in (pair, turns, profile, sigma):
            draw(seen)
        print(seen.calibration)
    if only != 'plots':
        report()


if __name__ == '__main__':
    main()
