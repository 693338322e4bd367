# SPDX-License-Identifier: Apache-2.0
"""dashcalib compare and export: calibrations of files, without a drive."""
from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from rich.console import Group

from dashcalib_ros.arrays import plain_values
from dashcalib_ros.cli.arguments import ACCEPTED, Celsius, UsageError
from dashcalib_ros.cli.terminal import print_json, show, warn
from dashcalib_ros.errors import Notice
from dashcalib_ros.formats import export as exported
from dashcalib_ros.formats import load_calibration, load_camera
from dashcalib_ros.formats.export import EXPORTS, check_suffix, cropped, resized
from dashcalib_ros.formats.load import load_pair
from dashcalib_ros.formats.rig import is_rig, load_rig
from dashcalib_ros.input.source import size_text
from dashcalib_ros.report import compare as compare_cameras
from dashcalib_ros.report import write_text
from dashcalib_ros.report.page import difference_html
from dashcalib_ros.report.rig import change_lines
from dashcalib_ros.report.tables import comparison, line
from dashcalib_ros.report.wording import verdict_text
from dashcalib_ros.rig.moved import changes
from dashcalib_ros.standard_streams import write_stdout


def compare(args: argparse.Namespace) -> int:
    """Show how far A differs from B, and for which uses A is good enough."""
    if is_rig(args.a) or is_rig(args.b):
        return _rigs(args)
    found = compare_cameras(*load_pair(args.a, args.b))
    warn((*found.a.warnings, *found.b.warnings))
    if args.html is not None:
        write_text(args.html, difference_html(found))
    if args.json:
        print_json(found.to_dict())
    else:
        show(comparison(found))
        if args.html is not None:
            write_stdout(f'written: {args.html}, a map of the difference')
    return ACCEPTED


def _rigs(args: argparse.Namespace) -> int:
    """Show which cameras of rig A were moved since rig B."""
    if args.html is not None:
        raise UsageError('E-RIG-HTML', '--html maps the difference of two calibrations of one '
                                       'camera; omit it for rigs')
    found = changes(load_rig(args.a), load_rig(args.b))
    if args.json:
        print_json({'answer': found.answer, **plain_values(found)})
    else:
        show(Group(*map(line, change_lines(found))))
    return ACCEPTED


def export(args: argparse.Namespace) -> int:
    """Write the camera to --out, or to standard output."""
    found = load_camera(args.calibration, image_size=args.size, nearest=args.nearest)
    warn(found.warnings)
    if isinstance(args.at, Celsius):
        if found.drift is None or found.drift.fx_percent_per_kelvin is None:
            raise UsageError('E-NO-TEMPERATURE', 'the focal length is not known to follow the '
                             'temperature: omit --at, or calibrate with --temperature')
        found = replace(found, camera=found.at_temperature(args.at), covariance=None)
    elif args.at is not None:
        camera, sigma = load_calibration(args.calibration).at(args.at)
        found = replace(found, camera=camera, sigma=sigma, covariance=None)
    camera, readout_ms = found.camera, found.readout_ms
    if args.size not in (None, camera.image_size):
        camera = resized(camera, args.size)
    if args.crop is not None:
        whole, camera = camera, cropped(camera, *args.crop)
        readout_ms = readout_ms and readout_ms * camera.image_size[1] / whole.image_size[1]
    keeps = EXPORTS[args.to].keeps if args.to in EXPORTS else ()
    if found.field is not None and 'field' in keeps and camera is not found.camera:
        raise UsageError('E-FIELD-OF-PART', 'the residual distortion is known for the whole '
                         'picture only; omit --size and --crop')
    if args.out is not None:
        check_suffix(args.out, args.to)
    content = exported(replace(found, camera=camera, readout_ms=readout_ms), args.to)
    if readout_ms is None and 'readout_ms' in keeps:
        warn([Notice('E-EXPORT-NO-READOUT', f'{found.name} has no readout time of a rolling '
                     f'shutter: set it in {args.to}, unless the shutter is global')])
    if 'mount' in keeps and found.mount is not None and found.mount.verdict == 'weak':
        warn([Notice('E-EXPORT-MOUNT-WEAK',
                     f'{found.name}: its mounting is {verdict_text(found.mount)}')])
    if found.field is not None and not {'field', 'mount'} & set(keeps):
        lost = found.field.over(found.camera)
        others = ', '.join(kind for kind, form in EXPORTS.items() if 'field' in form.keeps)
        warn([Notice(
            'E-EXPORT-FIELD-LOST',
            f'{found.name} has residual distortion, for which {args.to} has no place: '
            f'without it pixels are off by {np.sqrt(np.mean(lost**2)):.2f} px RMS and '
            f'{lost.max():.2f} px at the worst (of {size_text(found.image_size)}); export to '
            f'{others} to keep it')])
    if found.verdict == 'weak':
        warn([Notice('E-EXPORT-WEAK', f'{found.name} is weak: look at its standard deviations '
                     f'(sigma) before you use it')])
    if args.out is not None:
        write_text(args.out, content)
    elif isinstance(content, bytes):
        raise UsageError('E-OUT-NEEDED',
                         f'--to {args.to} writes a binary file; add --out {args.to}'
                         f'{EXPORTS[args.to].suffixes[0]}')
    else:
        write_stdout(content.rstrip('\n'))
    return ACCEPTED
