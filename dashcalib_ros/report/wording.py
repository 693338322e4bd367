# SPDX-License-Identifier: Apache-2.0
"""Texts and numbers that the page and the terminal have in common."""
from __future__ import annotations

import math
import posixpath
from shlex import quote

import numpy as np

from dashcalib_ros.judge import CalibrationData, TurnSummary, Verdict
from dashcalib_ros.judge.calibration import Condition, Known, Mount, Witnesses

ADVICE = {
    'accepted': 'Good to use.',
    'weak': 'There are numbers, but they may be wrong: read the reasons first.',
    'refused': 'There is no calibration: this drive does not show enough.',
}
# where a calibration that others load is written, by its verdict, and the usual folder
ACCEPTED, WEAK, FOLDER = 'calibration.yaml', 'calibration.weak.yaml', 'calibration'
# where a verdict has no remedies
NEXT = {
    'accepted': 'use calibration.yaml in the camera driver; report.html has the details',
    'weak': 'read report.html before you use calibration.weak.yaml',
    'refused': 'record a drive with turns at crossings, in daylight',
}

# parameters that are lengths in the picture; the others have no unit
PIXELS = ('fx', 'fy', 'cx', 'cy')
# head of the table of parameters
PARAMETERS = ('', 'estimate', 'sigma', 'relative')


def file_of(verdict: Verdict) -> str:
    """Return the name of the file that has the camera of a result."""
    return ACCEPTED if verdict.level == 'accepted' else WEAK


def parameter_rows(calibration: CalibrationData) -> list[tuple[str, str, str, str]]:
    """Return each parameter's name, value, sigma and sigma in percent, as text."""
    rows = []
    for name, value in ({} if calibration.camera is None else calibration.camera.named).items():
        sigma = (calibration.sigma or {}).get(name, math.inf)
        absolute, relative = '± ' + number(name, sigma), ''
        if not math.isfinite(sigma):
            absolute = 'unknown'
        elif value:
            share = 100 * sigma / abs(value)
            # one as large as its value has no sensible digits
            relative = ('over 100 %' if share > 100 else
                        f'{share:.0f} %' if share >= 10 else f'{share:.2f} %')
        rows.append((name, number(name, value), absolute, relative))
    return rows


def number(name: str, value: float | None) -> str:
    """Return a parameter's value with its significant digits and its unit; a dash for None."""
    if value is None:
        return '-'
    return f'{value:.{digits_of(name)}f}' + (' px' if name in PIXELS else '')


def digits_of(name: str) -> int:
    """Return how many digits after the point a parameter and its sigma need."""
    if name in PIXELS:
        return 2
    # the coefficients of higher terms, and of a lens that is decentred, are small
    return 4 if name.partition(' ')[0] in ('k1', 'k2') else 6


# of each angle of a mounting: its name, and where it goes when it is positive, and negative
WAYS = {'yaw_left_deg': ('yaw', 'to the left', 'to the right'),
        'pitch_up_deg': ('pitch', 'up', 'down'),
        'roll_right_deg': ('roll', 'to the right', 'to the left')}


def angle_text(name: str, degrees: float | None, sigma: float | None) -> str:
    """Return an angle of a mounting with its direction, so that it needs no sign."""
    word, positive, negative = WAYS[name]
    if degrees is None or sigma is None:
        return f'{word} unknown'
    return f'{word} {abs(degrees):.2f} ± {sigma:.2f}° {positive if degrees >= 0 else negative}'


def mounts_text(mount: Mount, other: Mount) -> str:
    """Return how far a mounting is from another one, and whether the camera was moved."""
    parts = [angle_text(name, *apart) for name, apart in mount.apart(other).items()]
    moved = 'the camera was moved' if mount.moved_from(other) else 'it sits as before'
    return f'mounting: differs by {", ".join(parts)}: {moved}'


def verdict_text(mount: Mount) -> str:
    """Return a mounting's verdict, and why it is weak."""
    return mount.verdict + (f' ({"; ".join(map(str, mount.reasons))})' if mount.reasons else '')


def mount_text(mount: Mount) -> str:
    """Return how the camera sits on the car, with its verdict."""
    parts = [angle_text(name, getattr(mount, name), mount.sigma[name]) for name in WAYS]
    height = mount.sigma['height_m']
    parts.append('height unknown without a speed' if mount.height_m is None or height is None
                 else f'{mount.height_m:.2f} ± {height:.2f} m above the road')
    way = 'comes from' if mount.rear else 'travels towards'
    return (f'{verdict_text(mount)}: {", ".join(parts)}; the car {way} pixel '
            f'{mount.travel_px[0]:.1f}, {mount.travel_px[1]:.1f} ± {mount.travel_sigma_px:.1f} px')


def witness_texts(witnesses: Witnesses) -> list[str]:
    """Return a line for each sensor: what it knows about the focal length, and of its clock."""
    lines = []
    for name, each in (('gyro', witnesses.gyro), ('GPS', witnesses.gps),
                       ('odometry', witnesses.odometry)):
        if each is None:
            continue
        parts, word = [], ''
        if each.fx_percent is not None:
            word = ' agrees' if each.agrees else ' contradicts'
            parts.append(f'fx off by {each.fx_percent:+.2f} ± {each.fx_sigma_percent:.2f} %')
        if each.time_offset_s is not None and each.time_sigma_s is not None:
            parts.append(f'its time stamps late by {1e3 * each.time_offset_s:.0f} ± '
                         f'{max(1e3 * each.time_sigma_s, 0.1):.1f} ms')
        if each.drift_ppm is not None:
            parts.append(f'its clock drifting by {each.drift_ppm:+.0f} ± '
                         f'{each.drift_sigma_ppm:.0f} ppm')
        if each.scale_by_gps is not None:
            parts.append('its angles {:.4f} ± {:.4f} times those of GPS'.format(
                *each.scale_by_gps))
        lines.append(f'the {name}{word}: {", ".join(parts)}')
    return lines


# of each piece of knowledge: the unit that is shown, and the factor to it from result.json's
UNITS = {'fx': (' px', 1.0), 'hfov': ('°', 1.0), 'shutter': (' ms', 1e3), 'height': (' m', 1.0)}


def known_text(piece: Known) -> str:
    """Return what somebody knew about the camera, what the turns say, and what it contributed."""
    unit, times = UNITS.get(piece.name, ('', 1.0))
    known, turns = (f'{times * value:.5g} ± {times * sigma:.2g}{unit}' for value, sigma in (
        (piece.value, piece.sigma), (piece.by_turns, piece.by_turns_sigma)))
    return (f'{piece.name} {known}, the turns say {turns}: ' + (
        f'fx is known to {piece.fx_sigma:.2g} px instead of {piece.fx_sigma_without:.2g}'
        if piece.used else 'it does not count'))


def since_start(turn: TurnSummary, calibration: CalibrationData) -> str:
    """Return when a turn was, in s since the start of the drive, as on the plot's axis."""
    return f'{turn.stamp_s - calibration.start_s:.1f}'


def key_figures(c: CalibrationData) -> list[tuple[str, str, str]]:
    """Return the figures that matter most: a name, a value, and what belongs to it."""
    yaw = c.yaw_deg
    found = [('turns used', f'{c.turns_used}',
              f'of {len(c.turns) + len(c.stored_turns)} found, {yaw:.0f}° of yaw in all')]
    if c.camera is None:
        return [*found, ('images', f'{c.frames}', f'of {c.image_size[0]} × {c.image_size[1]} px'),
                ('yaw of these turns', f'{yaw:.0f}°',
                 f'at least {c.config.verdict.min_yaw_deg:.0f}° are needed')]
    front, lone = [], c.caveat and f'; {c.caveat}'
    if c.sigma_px is not None:
        front.append(('uncertainty in the picture', optional(c.sigma_px.rms, 2, ' px'),
                      f'RMS; {optional(c.sigma_px.worst, 2)} px at the worst place{lone}'))
    sigma = (c.sigma or {}).get('fx', math.nan)
    front.append(('focal length fx', f'{c.camera.fx:.1f} px',
                  (f'± {sigma:.1f} px, {100 * sigma / c.camera.fx:.2f} %'
                   if math.isfinite(sigma) else 'uncertainty unknown') + lone))
    across, down, diagonal = (optional(angle, 1, '°') for angle in c.camera.field_of_view)
    front.append(('field of view', across, f'by {down}, diagonal {diagonal}'))
    return [*front, *found]


def remedies(verdict: Verdict) -> tuple[str, ...]:
    """Return what to do next, the likeliest to help first; of a refused result that one."""
    found = verdict.remedies or (NEXT[verdict.level],)
    return found[:1] if verdict.level == 'refused' else found


def next_steps(c: CalibrationData, folder: str = FOLDER) -> list[str]:
    """Return what to do next, most useful first. folder: where the result is written."""
    file = f'`{quote(posixpath.join(folder, file_of(c.verdict)))}`'
    glass = [] if c.field is None or not c.field.used else [
        'A windscreen, or a rectification, bends the picture beside the lens. In Python, '
        f'`dashcalib_ros.Calibration.load({folder!r}).undistort(image)` removes this, too.']
    needed = c.config.verdict
    together = ('Short drives add up: with `--set turns.store=FOLDER`, each run uses the turns of '
                'those before it.')
    if c.verdict.level == 'accepted':
        steps = [f'Use {file} in the camera driver, or copy the lines below.']
        steps += glass
        if (c.sigma or {}).get('fx', 0.0) > 0.005 * (c.camera.fx if c.camera else 1.0):
            steps.append('It can become more exact: another drive with sharp turns lowers the '
                         'uncertainty. ' + together)
        return [*steps,
                'To check it with another drive of the same camera: '
                f'`dashcalib check {quote(folder)} DRIVE`.',
                'Calibrate again when the lens, the zoom, the focus or the video mode changes. '
                'Moving the camera on the car changes ' + (
                    'nothing here.' if c.mount is None else
                    'the mounting only: drive again for it, also straight on.')]
    yaw = c.yaw_deg
    steps = [f'{remedy[0].upper()}{remedy[1:]}.' for remedy in remedies(c.verdict)]
    if c.turns_used < c.config.turns.wanted or yaw < needed.min_yaw_deg:
        steps.append(f'For the next drive: {c.config.turns.wanted} turns of 60° or more, at town '
                     f'speed, in daylight. At least {needed.min_turns} turns and '
                     f'{needed.min_yaw_deg:.0f}° together are needed; this drive has '
                     f'{c.turns_used} and {yaw:.0f}°. Turning on the spot does not count.')
    else:
        steps.append('For the next drive: turns of 60° or more, at town speed, in daylight, with '
                     'little traffic ahead.')
    if c.verdict.level == 'refused':
        return [' '.join(steps)]
    return [*steps, together,
            f'To use it all the same, rename {file}; mind its sigmas.', *glass]


def run_facts(c: CalibrationData) -> list[tuple[str, str]]:
    """Return what else is known about the run: a name, and a text."""
    facts = [('images', f'{c.frames} of {c.image_size[0]} × {c.image_size[1]} px')]
    clips = any(turn.clip for turn in c.stored_turns)
    for name, turns in (('turns', c.turns), (
            f'turns{" of earlier drives" * (not clips)}', c.stored_turns)):
        if turns:
            facts.append((name, f'{sum(turn.used for turn in turns)} of {len(turns)} used'))
    if c.camera is not None:
        facts.append(('lens model', c.camera.model))
    if c.reprojection_error_px is not None:
        facts.append(('reprojection error', f'{c.reprojection_error_px:.2f} px'))
    if c.sigma_px is not None:
        facts.append(('sigma over the picture',
                      f'{c.sigma_px.rms:.2f} px RMS, {c.sigma_px.worst:.2f} px at the worst place'
                      ))
    if c.rolling_shutter is not None:
        facts.append(('rolling shutter', f'{c.rolling_shutter.readout_ms:.1f} ± '
                                         f'{c.rolling_shutter.sigma_ms:.1f} ms, removed'))
    if c.field is not None and c.field.used:
        facts.append(('beside the lens model', c.field.text))
    if c.stabiliser is not None:
        facts.append(('stabiliser', f'moved the picture by up to {c.stabiliser.largest_px:.0f} '
                                    'px, removed'))
    if c.straight_lines is not None:
        lines = c.straight_lines
        facts.append(('upright lines', f'{lines.lines} found, bent by {lines.bend_px:.2f} px: '
                                       f'{lines.change}'))
    if c.mask is not None and not c.mask.all():
        facts.append(('not used', f'{100 * (1 - float(np.mean(c.mask))):.1f} % of the picture, '
                                  f'which moves with the car (bonnet, pillar, burnt-in text)'))
    if c.mount is not None:
        facts.append(('mounting', mount_text(c.mount)))
    facts += [('known before', known_text(piece)) for piece in c.known]
    facts += [('motion sensor', text) for text in witness_texts(c.witnesses)]
    times = ', '.join(f'{name} {seconds:.1f} s' for name, seconds in c.timing.items())
    return [*facts, ('time', times)] if times else facts


def optional(value: float | None, digits: int, unit: str = '') -> str:
    """Return a number with its unit, or a dash for one that is not known."""
    return '-' if value is None or not math.isfinite(value) else f'{value:.{digits}f}{unit}'


def conditions(verdict: Verdict) -> tuple[Condition, ...]:
    """Return the conditions of a verdict; of one without any, its reasons."""
    return verdict.conditions or tuple(Condition(each.code, each.what, '', '', False)
                                       for each in verdict.reasons)
