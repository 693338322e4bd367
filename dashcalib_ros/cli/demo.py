# SPDX-License-Identifier: Apache-2.0
"""dashcalib demo: a rendered drive, calibrated and compared with the truth."""
from __future__ import annotations

import argparse
import dataclasses
import io
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from rich.console import RenderableType

from dashcalib_ros.arrays import plain_values
from dashcalib_ros.camera import camera_of
from dashcalib_ros.camera.mapping import Apart, apart_at, grid_of
from dashcalib_ros.cli.arguments import ACCEPTED, NOT_ENOUGH, exit_code
from dashcalib_ros.cli.drive import read_config
from dashcalib_ros.cli.rig import write_rig
from dashcalib_ros.cli.run import files_line, now, warn_of
from dashcalib_ros.cli.terminal import Screen, Stages, print_json
from dashcalib_ros.config import Config
from dashcalib_ros.demo import (
    DEMOS,
    Drive,
    demo_drive,
    render_to_bag,
    rig_drives,
    true_places,
)
from dashcalib_ros.errors import OutputError
from dashcalib_ros.formats import calibrated_camera, result_dict
from dashcalib_ros.formats.rig import rig_json
from dashcalib_ros.input.inputs import open_frames
from dashcalib_ros.report import (
    Calibration,
    NamedCamera,
    compare,
    output_folder,
    write_results,
    write_text,
)
from dashcalib_ros.report.files import TRUTH
from dashcalib_ros.report.rig import rig_lines
from dashcalib_ros.report.tables import against_truth, conclusion, line, next_step, summary
from dashcalib_ros.report.wording import optional
from dashcalib_ros.rig_session import rig_of_drives
from dashcalib_ros.session import Recording, calibrate_drive
from dashcalib_ros.standard_streams import write_stdout
from dashcalib_ros.whole_files import temporary_folder

# behind a windscreen no parameters are the whole truth: the viewing ray of each pixel is
TRUE_RAYS = 'truth_rays.npz'


def demo(args: argparse.Namespace) -> int:
    """Render, calibrate, compare with the truth; return the verdict's exit code."""
    started = perf_counter()
    config = read_config(args)
    if args.rig:
        return _rig(args, config, started)
    drive, about = demo_drive(config.seed, args.lens), DEMOS[args.lens].about
    screen = Screen(args.quiet, to_stderr=args.json)
    screen.show(line(f'rendered: {about}'))
    with output_folder(args.out) as out:
        with Stages(args.quiet) as stages, _bag_path(out, args.keep_bag) as bag:
            stages.show('rendering the drive')
            render_to_bag(drive, bag, lambda done: stages.show('rendering the drive', done))
            calibration = calibrate_drive(Recording(open_frames(bag)), config, stages,
                                          args.verbose)
        calibration = dataclasses.replace(
            calibration, input_name=f'demo drive {config.seed}, {args.lens}')
        lens = NamedCamera('truth', camera_of(drive.lens.model, drive.lens.size,
                                              list(drive.truth.values())))
        bent = drive.lens.glass is not None
        written = write_results(calibration, out, created=now(), truth=None if bent else lens)
        truth = {'drive': about, **truth_of(drive)}
        write_text(out / TRUTH, json.dumps(truth, allow_nan=False) + '\n')
        (out / TRUE_RAYS).unlink(missing_ok=True)
        if bent:
            write_text(out / TRUE_RAYS, _true_rays(drive))
    warn_of(calibration, written)
    found = None if calibration.camera is None else mapping_error(calibration, drive)
    if args.json:
        print_json(plain_values({**result_dict(calibration), 'truth': truth,
                                 'mapping_px': None if found is None else found.rms}))
    names = [TRUTH, *[TRUE_RAYS] * bent, *['bag'] * args.keep_bag]
    screen.show(
        conclusion(calibration.verdict), summary(calibration),
        *_compared(calibration, drive, lens, found),
        files_line(out, [*written.files, *map(out.joinpath, names)]),
        line(f'rendered and calibrated in {perf_counter() - started:.0f} s'),
        next_step(calibration.verdict))
    return exit_code(calibration.verdict.level)


def _rig(args: argparse.Namespace, config: Config, started: float) -> int:
    drives = rig_drives(seed=config.seed)
    base, screen = next(iter(drives)), Screen(args.quiet, to_stderr=args.json)
    truth = {name: each.values for name, each in true_places(drives, base).items()}
    with output_folder(args.out) as out:
        with Stages(args.quiet) as stages, temporary_folder() as folder:
            bags = {}
            for name, drive in drives.items():
                bags[name] = (out if args.keep_bag else folder) / f'bag-{name}'
                stages.show(f'rendering {name}')
                render_to_bag(drive, bags[name])
            found = rig_of_drives({name: Recording(open_frames(bag))
                                   for name, bag in bags.items()}, base, config, stages)
        write_rig(found, out)
        write_text(out / TRUTH, json.dumps({'base': base, 'cameras': truth}, allow_nan=False)
                   + '\n')
    if args.json:
        write_stdout(rig_json(found.rig).rstrip('\n'))
    screen.show(*(line(text) for text in rig_lines(found.rig.cameras)),
                line(f'truth: {json.dumps(truth)}'),
                line(f'rendered and calibrated in {perf_counter() - started:.0f} s'))
    return ACCEPTED if found.rig.accepted else NOT_ENOUGH


def truth_of(drive: Drive) -> dict[str, Any]:
    """Return what truth.json says about a drive: the lens, and what else a run may find."""
    width, height = drive.lens.size
    spec, glass = drive.spec, drive.lens.glass
    found: dict[str, Any] = {'model': drive.lens.model, **drive.truth, 'width': width,
                             'height': height, 'readout_ms': spec.rolling_shutter_ms}
    if glass is not None:
        found['windscreen_rms_px'] = glass.rms_px
    if spec.stabilised:
        found['stabiliser_px'] = float(np.abs(drive.crop_px).max())
    return found


def mapping_error(calibration: Calibration, drive: Drive, with_field: bool = True) -> Apart | None:
    """Return how far the calibration sees the true viewing rays from their pixels.

    with_field: take the residual distortion into account, where one is used.
    """
    assert calibration.camera is not None
    pixels, field = grid_of(calibration.camera), calibration.field
    used = with_field and field is not None and field.used
    return apart_at(calibration.camera, drive.lens.rays(pixels),
                    field.field.ideal(pixels) if used and field is not None else pixels)


def _compared(calibration: Calibration, drive: Drive, lens: NamedCamera, found: Apart | None
              ) -> Iterator[RenderableType]:
    if calibration.camera is None:
        yield line('no estimate to compare with the truth')
        return
    yield line('')
    yield line('against the truth')
    both = compare(calibrated_camera(calibration), lens)
    # the lens has no glass, and the estimate no field: the rays have both
    yield against_truth(dataclasses.replace(
        both, whole=dataclasses.replace(both.whole, apart=found)))
    if drive.lens.glass is not None:
        without = mapping_error(calibration, drive, with_field=False)
        yield line(f'the windscreen bends the picture by {drive.lens.glass.rms_px:.2f} px RMS; '
                   f'mapping error without the field of the calibration: '
                   f'{optional(None if without is None else without.rms, 2, " px")}')
    shutter, true_ms = calibration.rolling_shutter, drive.spec.rolling_shutter_ms
    if shutter is not None or true_ms:
        estimate = ('not found' if shutter is None else
                    f'{shutter.readout_ms:.1f} ± {shutter.sigma_ms:.1f} ms')
        yield line(f'readout time of the rows: {estimate}; truth: {true_ms:.1f} ms')
    if calibration.stabiliser is not None or drive.spec.stabilised:
        estimate = ('not found' if calibration.stabiliser is None else
                    f'by up to {calibration.stabiliser.largest_px:.0f} px')
        yield line(f'movement of the picture: {estimate}; truth: by up to '
                   f'{np.abs(drive.crop_px).max():.0f} px')


def _true_rays(drive: Drive) -> bytes:
    width, height = drive.lens.size
    pixels = np.stack(np.meshgrid(np.arange(float(width)), np.arange(float(height))), -1)
    rays = drive.lens.rays(pixels.reshape(-1, 2)).reshape(height, width, 3)
    file = io.BytesIO()
    np.savez(file, rays=rays.astype(np.float32), image_size=np.array(drive.lens.size))
    return file.getvalue()


@contextmanager
def _bag_path(out: Path, keep: bool) -> Iterator[Path]:
    if keep:
        if (out / 'bag').exists():
            raise OutputError('E-BAG-EXISTS', f'{out / "bag"} exists: remove it or choose another '
                                              f'--out')
        yield out / 'bag'
        return
    with temporary_folder() as folder:
        yield folder / 'bag'
