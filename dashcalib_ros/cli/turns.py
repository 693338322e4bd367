"""dashcalib turns: detection only."""
from __future__ import annotations

import argparse
import json
from typing import Any

from rich.text import Text

from dashcalib_ros.cli import exit_codes
from dashcalib_ros.cli.drive import feed
from dashcalib_ros.cli.settings import read_config
from dashcalib_ros.cli.terminal import Stages, show, show_text, warn
from dashcalib_ros.frames.mask_file import read_mask
from dashcalib_ros.inputs import open_frames
from dashcalib_ros.report.result import plain_values
from dashcalib_ros.report.tables import text_table
from dashcalib_ros.turns import Turn
from dashcalib_ros.turns.detection import Detection

COLUMNS = ('frame', 'from', 'to', 'at s', 'prominence', 'images')


def turns(args: argparse.Namespace) -> int:
    """List the turns found, best first. The exit code is 0, also if there are none."""
    config = read_config(args)
    mask = None if args.mask is None else read_mask(args.mask)
    source = open_frames(args.input, topic=args.topic, fps=args.fps)
    detection = Detection(config, mask)
    with Stages() as stages:
        frames = feed(detection, source, mask, stages)
    detection.finish()
    found = [_row(turn) for turn in detection.turns()]
    warn((*source.warnings, *detection.warnings()))
    if args.json:
        show_text(json.dumps(plain_values({
            'input': source.name, 'frames': frames, 'turns': found,
            'warnings': (*source.warnings, *detection.warnings())}), indent=2, allow_nan=False))
        return exit_codes.ACCEPTED
    if found:
        show(text_table(COLUMNS, [_cells(row) for row in found]))
    show(Text(f'{len(found)} of {config.turns.wanted} turns wanted, in {frames} frames'))
    return exit_codes.ACCEPTED


def _row(turn: Turn) -> dict[str, Any]:
    return {'center': turn.center, 'first': turn.first, 'last': turn.last,
            'stamp': turn.stamp_s, 'prominence': turn.prominence, 'images': turn.images}


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    return (str(row['center']), str(row['first']), str(row['last']), f'{row["stamp"]:.1f}',
            f'{row["prominence"]:.4f}', str(row['images']))
