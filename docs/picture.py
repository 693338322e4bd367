#!/usr/bin/env python3
"""Draw docs/picture.png from the demo drive: python docs/picture.py (needs matplotlib)."""
from __future__ import annotations

from pathlib import Path

import cv2
import matplotlib.pyplot as plt
import numpy as np

from dashcalib_ros import Calibrator
from dashcalib_ros.demo import demo_drive


def main() -> None:
    """Calibrate the demo drive and draw what happened."""
    drive = demo_drive()
    frames = list(drive.frames(processes=2))
    with Calibrator() as calibrator:
        for frame in frames:
            calibrator.push(frame)
        result = calibrator.calibrate()
    assert result.intrinsics and result.sigma and result.magnitudes is not None
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 3.5), width_ratios=(1, 1.1))
    picture = np.dstack([frames[drive.turn_centers[0]].image] * 3)
    if result.mask is not None:
        picture[~result.mask] = picture[~result.mask] // 2 + np.uint8([110, 0, 0])
    left.imshow(picture)
    left.set_axis_off()
    left.set_title('the ego vehicle, found by itself (red)')
    first = frames[0].stamp_ns / 1e9
    right.plot(result.magnitudes[:, 0] - first, 100 * result.magnitudes[:, 1], color='k', lw=1.2)
    for turn in result.turns:
        begin, end = (frames[index].stamp_ns / 1e9 - first for index in (turn.first, turn.last))
        right.axvspan(begin, end, color='tab:green', alpha=0.25, lw=0)
    right.set(xlabel='s', ylabel='turning magnitude, % of the width')
    names = ('fx', 'fy', 'cx', 'cy', 'k1', 'k2')
    lines = [f'{"":3}{"estimate":>10}{"sigma":>8}{"truth":>10}']
    for name in names:
        values = (getattr(source, name)
                  for source in (result.intrinsics, result.sigma, drive.truth))
        digits = 2 if name[0] != 'k' else 4
        cells = [f'{value:.{digits}f}' for value in values]
        lines.append(f'{name:3}{cells[0]:>10}{cells[1]:>8}{cells[2]:>10}')
    right.set_title(f'the turns it learns from: {result.verdict.level}')
    right.text(1.03, 0.5, '\n'.join(lines), family='monospace', va='center',
               transform=right.transAxes, fontsize=9)
    figure.tight_layout()
    out = Path(__file__).with_name('picture.png')
    figure.savefig(out, dpi=80)
    # fewer colours: the picture is in every clone
    image = cv2.imread(str(out))
    cv2.imwrite(str(out), image, [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == '__main__':
    main()
