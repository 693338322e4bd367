"""dashcalib export: a calibration as another program's camera file."""
from __future__ import annotations

import argparse

from dashcalib_ros.cli import exit_codes
from dashcalib_ros.cli.terminal import show_text, warn
from dashcalib_ros.report import load_camera, write_text
from dashcalib_ros.report.export import cropped, exported, resized


def export(args: argparse.Namespace) -> int:
    """Write the camera to --out, or to standard output."""
    found = load_camera(args.calibration)
    camera = found.camera
    if args.size is not None:
        camera = resized(camera, args.size)
    if args.crop is not None:
        camera = cropped(camera, *args.crop)
    text = exported(camera, args.to)
    if found.verdict == 'weak':
        warn([f'{found.name} is weak: look at its sigmas before you use it'])
    if args.out is None:
        show_text(text.rstrip('\n'))
    else:
        write_text(args.out, text)
    return exit_codes.ACCEPTED
