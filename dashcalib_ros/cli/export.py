"""dashcalib export: a calibration as another program's camera file."""
from __future__ import annotations

import argparse

from dashcalib_ros.cli import exit_codes
from dashcalib_ros.cli.arguments import UsageError
from dashcalib_ros.cli.terminal import show_text, warn
from dashcalib_ros.report import load_camera, write_text
from dashcalib_ros.report.export import WITH_FIELD, cropped, exported, resized


def export(args: argparse.Namespace) -> int:
    """Write the camera to --out, or to standard output."""
    found = load_camera(args.calibration)
    camera = found.camera
    if args.size is not None:
        camera = resized(camera, args.size)
    if args.crop is not None:
        camera = cropped(camera, *args.crop)
    text: str | bytes
    if found.field is not None and args.to in WITH_FIELD:
        if camera is not found.camera:
            raise UsageError('the field over the picture holds for the whole one; leave --size '
                             'and --crop away')
        text = WITH_FIELD[args.to](camera, found.field)
    else:
        text = exported(camera, args.to)
    if found.verdict == 'weak':
        warn([f'{found.name} is weak: look at its sigmas before you use it'])
    if args.out is not None:
        write_text(args.out, text)
    elif isinstance(text, bytes):
        raise UsageError(f'--to {args.to} is no text; add --out {args.to}.npz')
    else:
        show_text(text.rstrip('\n'))
    return exit_codes.ACCEPTED
