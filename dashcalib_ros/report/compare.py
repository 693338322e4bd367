# SPDX-License-Identifier: Apache-2.0
"""The comparison of two calibrations: differences, in sigmas too, and the mapping error."""
from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as default
from typing import Any

from dashcalib_ros.arrays import plain_values
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.mapping import unseen_share
from dashcalib_ros.errors import InputError
from dashcalib_ros.formats import Given, given_camera
from dashcalib_ros.input.source import size_text
from dashcalib_ros.judge import Check, Odometry
from dashcalib_ros.judge.calibration import Mount
from dashcalib_ros.judge.check import export_command, same_shape
from dashcalib_ros.judge.difference import (
    Answer,
    Difference,
    NamedCamera,
    answers_of,
    difference_between,
    misread_text,
)
from dashcalib_ros.report.wording import digits_of, mounts_text, number, optional


@dataclass(frozen=True)
class ParameterDifference:
    """One parameter of both. difference is a - b; percent is of b, None where b is zero.

    sigma: of the difference, from the sides that have one (both: the root of the sum of squares).
    z: difference / sigma. Both are None when neither side has a sigma. A coefficient that only one
    of the lens models has is named with it, as in 'k1 (fisheye)': the other side is None.
    """

    name: str
    a: float | None
    b: float | None
    difference: float | None
    percent: float | None
    sigma: float | None
    z: float | None


@dataclass(frozen=True, repr=False)
class Comparison:
    """What compare() found.

    whole: of both cameras, with their fields. unseen: of the image, where a's model can see no
    rays; it is left out. misread: in words, where a's distortion model is the wrong one.
    """

    a: NamedCamera
    b: NamedCamera
    differences: tuple[ParameterDifference, ...]
    whole: Difference = default(compare=False)
    unseen: float = 0.0
    misread: str = ''

    @property
    def answer(self) -> Answer:
        """Return right, differs, wrong or cannot tell, as Check.answer."""
        return self.whole.answer

    def __repr__(self) -> str:
        """Return one line: the names, and how far both are apart."""
        return f'Comparison({self.a.name} and {self.b.name}: {"; ".join(answers(self))})'

    @property
    def mapping_px(self) -> float | None:
        """Return the RMS over the image; None where a model folds over inside."""
        return self.whole.rms_px

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison as values of strict JSON."""
        sides = {side: {'name': camera.name, 'verdict': camera.verdict}
                 for side, camera in (('a', self.a), ('b', self.b))}
        rows = {d.name: dataclasses.asdict(d) for d in self.differences}
        for row in rows.values():
            del row['name']
        plain: dict[str, Any] = plain_values({
            **sides, 'image_size': self.b.image_size, 'parameters': rows,
            'mapping_px': self.mapping_px, 'worst_px': self.whole.worst_px,
            'unseen': self.unseen, 'sigma_px': self.whole.sigma_px,
            'answer': self.answer, 'misread': self.misread, 'good_for': self.whole.good_for,
            'told_apart': self.whole.told_apart, 'matters': self.whole.matters,
            'distance': self.whole.distance, 'limit': self.whole.limit,
            'bound_px': self.whole.bound_px, 'limits_px': self.whole.limits_px,
            'mount': mount_dict(self.a.mount, self.b.mount)})
        return plain


def mount_dict(mount: Mount | None, other: Mount | None) -> dict[str, Any] | None:
    """Return how far two mountings are apart as values of JSON; None where one is not known."""
    if mount is None or other is None:
        return None
    return {'moved': mount.moved_from(other), **{
        name: {'difference': degrees, 'sigma': sigma}
        for name, (degrees, sigma) in mount.apart(other).items()}}


def answer_dict(found: Check, changes: Sequence[str], motion: Odometry | None = None,
                mount: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return the answer of a drive about a given calibration as types of strict JSON.

    changes: of the camera during the drive, in words. motion: the comparison with true poses.
    mount: how far the mounting is from the calibration's.
    """
    values: dict[str, Any] = found.to_dict() | {
        'next_step': found.next_step, 'changes': list(changes), 'mount': mount}
    if motion is not None:
        values |= motion.medians() | {'clock': motion.clock and motion.clock.clock}
        values['turns'] = [{'center': turn.turn.number, 'true_deg': turn.angle_deg,
                            'length_m': turn.length_m,
                            'rotation_deg': {name: turn.rotation_deg(name)
                                             for name in motion.names},
                            'scale_drift': {name: turn.scale_drift(name)
                                            for name in motion.names}}
                           for turn in motion.turns]
    return values


def compare(a: Given, b: Given) -> Comparison:
    """Compare calibration a with the reference b.

    a, b: a Calibration, what load_camera() returns, a camera, or the path of a file that
    load_camera() reads. Returns a Comparison: mapping_px is how far apart both see the same rays,
    px RMS over the picture. Raises InputError if the image sizes differ or a file cannot be read.
    """
    a, b = given_camera(a), given_camera(b)
    if a.image_size != b.image_size:
        raise InputError('E-COMPARE-SIZE', _sizes_text(a, b))
    def again(camera: Camera) -> Difference:
        return difference_between(dataclasses.replace(a, camera=camera, covariance=None), b)

    whole = difference_between(a, b)
    misread = '' if whole.answer == 'right' else misread_text(a.camera, whole.rms_px, again)
    return Comparison(a, b, _rows(a, b), whole, unseen_share(a.camera, b.camera), misread)


def _sizes_text(a: NamedCamera, b: NamedCamera) -> str:
    text = (f'{a.name} is for pictures of {size_text(a.image_size)} and {b.name} for '
            f'{size_text(b.image_size)}, and only calibrations of one size can be compared; ')
    if same_shape(a.image_size, b.image_size):
        command = export_command(a.name, f'--size {size_text(b.image_size)}')
        return f'{text}resize the first: {command}'
    return text + 'crop one of them with dashcalib export --crop X,Y,W,H'


def _rows(a: NamedCamera, b: NamedCamera) -> tuple[ParameterDifference, ...]:
    """Return a row for each parameter of the larger model, if both are of one family.

    A distortion coefficient of the same name has another meaning in another family: those of both
    stand by themselves.
    """
    if a.camera.family == b.camera.family:
        names = max(a.camera.names(), b.camera.names(), key=len)
        return tuple(_difference(name, a, b) for name in names)
    alone = [ParameterDifference(f'{name} ({camera.model})', value if camera is a.camera else None,
                                 value if camera is b.camera else None, None, None, None, None)
             for camera in (a.camera, b.camera) for name, value in list(camera.named.items())[4:]]
    return (*(_difference(name, a, b) for name in a.camera.names()[:4]), *alone)


def _difference(name: str, a: NamedCamera, b: NamedCamera) -> ParameterDifference:
    value, reference = (each.camera.named.get(name, 0.0) for each in (a, b))
    difference = value - reference
    sigmas = [each.sigma[name] for each in (a, b)
              if each.sigma is not None and name in each.sigma]
    sigma = math.hypot(*sigmas) if sigmas else None
    return ParameterDifference(
        name, value, reference, difference,
        100 * difference / abs(reference) if reference else None,
        sigma, difference / sigma if sigma else None)


def comparison_rows(found: Comparison) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return the head and the rows of the parameters of both."""
    known = any(d.z is not None for d in found.differences)
    rows = [difference_row(d)[:None if known else -1] for d in found.differences]
    return ('', 'A', 'B', 'A - B', 'of B', 'sigmas')[:None if known else -1], rows


def answers(found: Comparison) -> list[str]:
    """Return how far both are apart, with the numbers that decide, and their mountings."""
    whose = ' and '.join(side for side, camera in (('A', found.a), ('B', found.b))
                         if camera.sigma_px is not None)
    lines = [f'answer: {found.answer}', *answers_of(found.whole, whose)]
    if found.whole.apart is not None:
        lines[1] += unseen_text(found)
    if found.misread:
        lines.append(f'of A: {found.misread}')
    if found.a.mount is not None and found.b.mount is not None:
        lines.append(mounts_text(found.a.mount, found.b.mount))
    return lines


def unseen_text(found: Comparison) -> str:
    """Return which part of the picture a distance leaves out, as an end of its sentence."""
    return '' if not found.unseen else (
        f'; without the {100 * found.unseen:.0f} % of the picture that the '
        f'{found.a.camera.model} model cannot see')


def difference_row(d: ParameterDifference) -> tuple[str, ...]:
    """Return a parameter's name, both values, their difference, in percent and in sigmas."""
    digits = max(4, digits_of(d.name))
    return (d.name, number(d.name, d.a), number(d.name, d.b),
            '-' if d.difference is None else f'{d.difference:+.{digits}f}',
            '-' if d.percent is None else f'{d.percent:+.3f} %', optional(d.z, 1))
