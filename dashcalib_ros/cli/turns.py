"""dashcalib turns: detection only."""
from __future__ import annotations

import argparse
import json
from typing import Any

from rich.text import Text

from dashcalib_ros.cli import exit_codes
from dashcalib_ros.cli.drive import feed, open_calibrator
from dashcalib_ros.cli.settings import read_config
from dashcalib_ros.cli.terminal import Stages, show, show_text, warn
from dashcalib_ros.frames import open_frames
from dashcalib_ros.frames.mask_file import read_mask
from dashcalib_ros.report.result import plain_values
from dashcalib_ros.report.tables import text_table

COLUMNS = ('frame', 'from', 'to', 'at s', 'prominence', 'images')


def turns(args: argparse.Namespace) -> int:
    """List the turns found, best first. None found is an answer too: exit code 0."""
    # detection only: no earlier drive's turns beside these, and none of these kept
    config = read_config(args).replace({'turns.store': ''})
    mask = None if args.mask is None else read_mask(args.mask)
    source = open_frames(args.input, topic=args.topic, fps=args.fps)
    with open_calibrator(config, mask, args.verbose) as calibrator:
        with Stages() as stages:
            frames = feed(calibrator, source, mask, stages)
        found = [_row(turn) for turn in calibrator.turns()]
    warn(source.warnings)
    if args.json:
        show_text(json.dumps(plain_values({
            'input': source.name, 'frames': frames, 'turns': found,
            'warnings': source.warnings}), indent=2, allow_nan=False))
        return exit_codes.ACCEPTED
    if found:
        show(text_table(COLUMNS, [_cells(row) for row in found]))
    show(Text(f'{len(found)} of {config.turns.wanted} turns wanted, in {frames} frames'))
    return exit_codes.ACCEPTED


def _row(turn: Any) -> dict[str, Any]:
    return {'center': turn.center, 'first': turn.first, 'last': turn.last,
            'stamp': turn.stamp_s, 'prominence': turn.prominence, 'images': turn.images}


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    return (str(row['center']), str(row['first']), str(row['last']), f'{row["stamp"]:.1f}',
            f'{row["prominence"]:.4f}', str(row['images']))
