# SPDX-License-Identifier: Apache-2.0
"""dashcalib run, and turns: what a run would use, without calibrating."""
from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path

from rich.console import Group
from rich.text import Text

from dashcalib_ros.arrays import plain_values
from dashcalib_ros.cli.arguments import ACCEPTED, exit_code
from dashcalib_ros.cli.drive import open_drive, read_config
from dashcalib_ros.cli.terminal import Screen, Stages, print_json, show, warn
from dashcalib_ros.errors import InputError, Notice, counted, spared
from dashcalib_ros.formats import result_json
from dashcalib_ros.formats.ours import codes_of
from dashcalib_ros.input import FrameSource
from dashcalib_ros.judge.conclude import Outlook
from dashcalib_ros.report import Calibration, Written, output_folder, write_results
from dashcalib_ros.report.tables import (
    TextTable,
    conclusion,
    line,
    next_step,
    summary,
)
from dashcalib_ros.report.wording import optional, remedies
from dashcalib_ros.session import calibrate_drive, outlook_of
from dashcalib_ros.standard_streams import write_stdout


def run(args: argparse.Namespace) -> int:
    """Calibrate, write the results, show them; return the verdict's exit code."""
    config = read_config(args)
    drive = open_drive(args)
    screen = Screen(args.quiet, to_stderr=args.json)
    with output_folder(args.out):
        if args.write_bag is not None:
            _check_bag(args, drive.source)
        with Stages(args.quiet) as stages:
            calibration = calibrate_drive(drive, config, stages, args.verbose)
        try:
            written = write_results(calibration, args.out, created=now())
        except Exception:
            # neither a full disk nor a defect may hide what an hour of work has found
            _show(args, calibration, screen, Written(()))
            raise
    _show(args, calibration, screen, written)
    if args.write_bag is not None:
        _write_bag(args, str(drive.source.topic), calibration, screen)
    screen.show(next_step(calibration.verdict))
    return exit_code(calibration.verdict.level)


def _show(args: argparse.Namespace, calibration: Calibration, screen: Screen, written: Written
          ) -> None:
    lost: list[Notice] = []
    shown = spared('the summary', lost, summary, calibration)
    warn_of(calibration, replace(written, lost=(*written.lost, *lost)))
    if args.json:
        write_stdout(result_json(calibration).rstrip('\n'))
    files = [files_line(args.out, written.files)] if written.files else []
    screen.show(conclusion(calibration.verdict), *([] if shown is None else [shown]), *files)


def _check_bag(args: argparse.Namespace, source: FrameSource) -> None:
    from dashcalib_ros.input.bag_write import check_bag
    if source.part is not None:
        raise InputError('E-BAG-PART', '--write-bag gives a camera_info to whole images: '
                                       'calibrate without --crop')
    if len(args.input) > 1 or source.name != str(Path(args.input[0])):
        raise InputError('E-BAG-SEVERAL', '--write-bag copies one bag: calibrate with all bags '
                                          'first, then use --write-bag with each bag alone')
    check_bag(args.input[0], source.topic, args.write_bag)


def _write_bag(args: argparse.Namespace, topic: str, calibration: Calibration, screen: Screen
               ) -> None:
    from dashcalib_ros.input.bag_write import camera_info_topic, write_bag
    if calibration.verdict.level != 'accepted':
        warn([Notice('E-BAG-NOT-WRITTEN', f'no bag was written: the calibration is '
                     f'{calibration.verdict.level}, not accepted')])
        return
    assert calibration.camera is not None
    count = write_bag(args.input[0], topic, calibration.camera, args.write_bag,
                      calibration.config.rectified)
    screen.show(line(f'written: {args.write_bag} with {count} messages on '
                     f'{camera_info_topic(topic)}'))


def files_line(folder: Path, files: Sequence[Path]) -> Text:
    """Return a line with the names of the files that were written to the output folder."""
    return line(f'written to {folder}: {", ".join(file.name for file in files)}')


def warn_of(calibration: Calibration, written: Written) -> None:
    """Print the calibration's warnings, and whether an earlier calibration was renamed."""
    warn((*calibration.warnings, *written.lost))
    if written.set_aside is not None:
        warn([Notice('E-CALIBRATION-RENAMED',
                     f'an earlier calibration was renamed to {written.set_aside}')])


def now() -> str:
    """Return the time as calibration.yaml's provenance has it."""
    return datetime.now(timezone.utc).isoformat(timespec='seconds')


COLUMNS = ('at s', 'frame', 'from', 'to', 'images', 'prominence', 'yaw °')
PROMINENCE = ('prominence: how far a turn stands out from the driving before and after it, as a '
              'fraction of the picture width; frames are counted from 0; yaw: of the turns that '
              'a calibration would use')
# degrees; drives without such a turn are accepted or weak, and turns alone do not tell which
SHARP_DEG = 30.0


def turns(args: argparse.Namespace) -> int:
    """List the turns, best first, and say whether they are enough; the exit code is 0."""
    config = read_config(args)
    drive = open_drive(args)
    with Stages(args.quiet) as stages:
        found = outlook_of(drive, config, stages)
    warnings = (*drive.source.warnings, *found.warnings)
    warn(warnings)
    yaws = found.yaws_deg
    if args.json:
        print_json(plain_values({
            'input': drive.source.name, 'frames': found.frames,
            'turns': [{'center': turn.center, 'first': turn.first, 'last': turn.last,
                       'stamp': turn.stamp_s, 'prominence': turn.prominence,
                       'images': turn.images, 'yaw_deg': yaws.get(turn.id)}
                      for turn in found.turns],
            'yaw_deg': sum(yaws.values()), 'verdict_at_best': found.verdict.level,
            'reasons': found.verdict.reasons, 'reason_codes': found.verdict.codes,
            'warnings': warnings, 'warning_codes': codes_of(warnings)}))
        return ACCEPTED
    if found.turns:
        show(TextTable(COLUMNS, [
            (f'{turn.stamp_s - found.start_s:.1f}', str(turn.center), str(turn.first),
             str(turn.last), str(turn.images), f'{turn.prominence:.4f}',
             optional(yaws.get(turn.id), 0)) for turn in found.turns]))
        show(line(PROMINENCE))
    show(Group(*map(line, _enough(found))))
    return ACCEPTED


def _enough(found: Outlook) -> tuple[str, str]:
    yaws, verdict = found.yaws_deg.values(), found.verdict
    text = f'{counted(len(found.turns), "turn")} found in {counted(found.frames, "frame")}'
    if yaws:
        text += (f'; a calibration would use {len(yaws)}, of {sum(yaws):.0f}° in all, the '
                 f'sharpest of {max(yaws):.0f}°')
    if not verdict.accepted:
        return (f'{text}: not enough, the result would be {verdict.level}: '
                f'{"; ".join(each.what for each in verdict.main_reasons)}',
                f'next: {remedies(verdict)[0]}')
    gentle = '' if max(yaws) >= SHARP_DEG else ', but without a sharp turn it may be weak'
    return f'{text}: enough for a calibration{gentle}', 'next: dashcalib run with the same INPUT'
