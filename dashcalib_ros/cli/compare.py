"""dashcalib compare: two calibrations side by side."""
from __future__ import annotations

import argparse
import json

from dashcalib_ros.cli import exit_codes
from dashcalib_ros.cli.terminal import show, show_text
from dashcalib_ros.report import compare as compare_cameras
from dashcalib_ros.report import load_camera, write_text
from dashcalib_ros.report.tables import comparison


def compare(args: argparse.Namespace) -> int:
    """Show the differences of A from B, and whether they matter."""
    found = compare_cameras(load_camera(args.a), load_camera(args.b))
    if args.html is not None:
        from dashcalib_ros.report.difference_page import difference_html
        write_text(args.html, difference_html(found))
    if args.json:
        show_text(json.dumps(found.as_dict(), indent=2, allow_nan=False))
    else:
        show(comparison(found))
        if args.html is not None:
            show_text(f'written: {args.html}, a map of the difference')
    return exit_codes.ACCEPTED
