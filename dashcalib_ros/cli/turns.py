"""dashcalib turns: detection only."""
from __future__ import annotations

import argparse
import json
from typing import Any

from rich.text import Text

from dashcalib_ros.cli.arguments import ACCEPTED
from dashcalib_ros.cli.drive import feed, open_drive, read_config
from dashcalib_ros.cli.terminal import Stages, show, warn
from dashcalib_ros.detect import Turn
from dashcalib_ros.detect.detection import Detection
from dashcalib_ros.errors import counted
from dashcalib_ros.report.result import plain_values
from dashcalib_ros.report.tables import TextTable
from dashcalib_ros.standard_streams import write_stdout

COLUMNS = ('at s', 'frame', 'from', 'to', 'images', 'prominence')
PROMINENCE = ('prominence: how far a turn stands out from the driving before and after it, as a '
              'share of the picture width; frames are counted from 0')


def turns(args: argparse.Namespace) -> int:
    """List the turns found, best first. The exit code is 0, also if there are none."""
    config = read_config(args)
    source, mask = open_drive(args)
    detection = Detection(config, mask)
    with Stages(args.quiet) as stages:
        frames = feed(detection, source, mask, stages)
    detection.finish()
    found = [_row(turn) for turn in detection.turns()]
    warn((*source.warnings, *detection.warnings()))
    if args.json:
        write_stdout(json.dumps(plain_values({
            'input': source.name, 'frames': frames, 'turns': found,
            'warnings': (*source.warnings, *detection.warnings())}), indent=2, allow_nan=False))
        return ACCEPTED
    if found:
        show(TextTable(COLUMNS, [_cells(row, detection.start_s) for row in found]))
        show(Text(PROMINENCE))
    show(Text(_conclusion(len(found), config.turns.wanted, frames)))
    return ACCEPTED


def _conclusion(found: int, wanted: int, frames: int) -> str:
    text = f'{found} of {counted(wanted, "turn")} wanted, in {counted(frames, "frame")}'
    if found:
        return f'{text}\nnext: dashcalib run, with the same INPUT'
    return f'{text}\nnext: record a drive with turns at crossings, in daylight'


def _row(turn: Turn) -> dict[str, Any]:
    return {'center': turn.center, 'first': turn.first, 'last': turn.last,
            'stamp': turn.stamp_s, 'prominence': turn.prominence, 'images': turn.images}


def _cells(row: dict[str, Any], start_s: float) -> tuple[str, ...]:
    return (f'{row["stamp"] - start_s:.1f}', str(row['center']), str(row['first']),
            str(row['last']), str(row['images']), f'{row["prominence"]:.4f}')
