# SPDX-License-Identifier: Apache-2.0
"""The answer: right, good enough, wrong and in which way, or that the drive cannot tell."""
from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from dataclasses import field as default
from fractions import Fraction
from shlex import quote
from typing import Any

import numpy as np

from dashcalib_ros.arrays import plain_values
from dashcalib_ros.camera import Camera
from dashcalib_ros.config import Config
from dashcalib_ros.detect import Bend, Lines, bend
from dashcalib_ros.input.scale import Scale
from dashcalib_ros.judge.calibration import Verdict
from dashcalib_ros.judge.difference import (
    Answer,
    Difference,
    Use,
    difference_of,
    misread_text,
    reasons_of,
)
from dashcalib_ros.judge.verdict import lines_contradict
from dashcalib_ros.solve.solution import Solution
from dashcalib_ros.solve.spread import PictureSigma


@dataclass(frozen=True, repr=False)
class Check:
    """What a drive says about a calibration that was given.

    answer: right: the given camera and the drive's own are the same within what the drive can
    determine, and near enough for the uses in good_for. differs: the difference is more than
    chance, and small enough for the uses in good_for. wrong: it is more than chance, and too large
    for every use. cannot tell: the error may be too large, and nothing shows whether it is.
    rms_px, worst_px: over the picture, between the given camera and the drive's own, the best
    common rotation removed; None where they cannot be compared. sigma_px: of the drive's own.
    told_apart: whether distance exceeds limit. distance: between the given camera and the drive's
    own, in standard deviations (sigma) with all correlations; limit: what chance exceeds once in
    a thousand drives. loss: by how much worse the turns are explained when they must use the
    given camera, of the cost with their own; None where it was not tried. straight_lines: what
    they say about the given camera; None where there are too few. bound_px: below which its error
    stays with 95 % confidence. limits_px: by use, what rms_px may be; bound_px may be
    twice that. good_for: the uses that allow the difference. remedy: of what else is wrong than
    the lens itself.
    """

    answer: Answer
    reasons: tuple[str, ...]
    rms_px: float | None = None
    worst_px: float | None = None
    sigma_px: PictureSigma | None = None
    told_apart: bool | None = None
    distance: float | None = None
    limit: float | None = None
    loss: float | None = None
    straight_lines: Bend | None = None
    bound_px: float | None = None
    limits_px: Mapping[Use, float] = default(default_factory=dict, hash=False)
    good_for: tuple[Use, ...] = ()
    remedy: str = ''

    @property
    def next_step(self) -> str:
        """Return what to do with the calibration."""
        if self.answer == 'wrong':
            return self.remedy or REPLACE
        if self.answer == 'cannot tell':
            return 'check it with a drive of more and sharper turns before you replace it'
        others = [use for use in self.limits_px if use not in self.good_for]
        keep = f'keep it{" for " if self.good_for else ""}{", ".join(self.good_for)}'
        if not others:
            return keep
        more = ('a drive with more turns may show whether it is good enough'
                if self.answer == 'right' else REPLACE)
        return f'{keep}; for {", ".join(others)}: {more}'

    def __repr__(self) -> str:
        """Return one line: the answer and its reasons."""
        return f'Check({self.answer}: {"; ".join(self.reasons)})'

    def to_dict(self) -> dict[str, Any]:
        """Return it as dicts, lists, text, finite numbers and None."""
        return dict(plain_values(self))


REPLACE = 'replace it with the calibration of this drive (dashcalib run)'

FIT_SIZE = 'write it for pictures of the size of this drive (dashcalib export --size or --crop)'
OTHER_MODEL = 'correct its distortion_model'
# what messages call the file of a camera whose file they do not know
CALIBRATION = 'CALIBRATION'


def check(given: Camera, image_size: tuple[int, int], solution: Solution | None, verdict: Verdict,
          config: Config, lines: Lines | None = None, name: str = CALIBRATION) -> Check:
    """Say whether a given camera explains a drive.

    image_size: of the drive's pictures. solution, verdict: of the drive; a solution that is not
    accepted neither confirms nor contradicts a calibration. lines: of the resized pictures. name:
    of the given camera's file, for the command that a message offers. Loads COLMAP.
    """
    found = _by_turns(given, image_size, solution, verdict, config, name)
    return found if lines is None else with_lines(found, given, lines, image_size, config)


def _by_turns(given: Camera, image_size: tuple[int, int], solution: Solution | None,
              verdict: Verdict, config: Config, name: str) -> Check:
    if verdict.level != 'accepted' or solution is None:
        if given.image_size == image_size:
            return Check('cannot tell', tuple(
                f'the drive has no accepted calibration of its own: {text}'
                for text in verdict.main_reasons))
        return Check('wrong', (size_reason(given, image_size, None, name),), remedy=FIT_SIZE)
    px = Scale.of(image_size, config).px

    def difference(camera: Camera) -> Difference:
        return difference_of(camera, solution, px)

    if not given.covers_picture():
        alike = (misread_text(given, None, difference) if given.image_size == image_size else '')
        return Check('wrong', ('its distortion folds over inside the picture: points near the '
                               'corners have no place in it', *filter(None, (alike,))),
                     remedy=OTHER_MODEL if alike else '')
    here = difference(replace(given, image_size=image_size))
    if given.image_size != image_size:
        # px of one size are not px of another: this is not an error
        return Check('wrong', (size_reason(given, image_size, difference, name),), remedy=FIT_SIZE)
    loss = loss_of(given.resized(1 / px, solution.camera.image_size), solution, config)
    scaled = scaled_parameters(here, difference) if here.answer == 'wrong' else ''
    alike = ('' if scaled or here.answer == 'right' else
             misread_text(given, here.rms_px, difference))
    reasons = (scaled,) if scaled else (*reasons_of(here), *filter(None, (alike,)))
    answer = here.answer
    if answer == 'wrong' and loss <= 0:
        # a calibration that explains the turns as well as their own is not contradicted by them
        answer, reasons = 'cannot tell', (UNDECIDED, *reasons[1:])
    return Check(answer, (*reasons, _loss_text(loss)), here.rms_px, here.worst_px, here.sigma_px,
                 here.told_apart, here.distance, here.limit, loss, bound_px=here.bound_px,
                 limits_px=here.limits_px, good_for=here.good_for,
                 remedy=FIT_SIZE if scaled else OTHER_MODEL if alike else '')


def with_faults(found: Check, faults: tuple[str, ...]) -> Check:
    """Return a check with the faults of what stands beside the camera: with any, it is wrong."""
    return replace(found, answer='wrong', reasons=(*faults, *found.reasons), good_for=(),
                   remedy='correct what is wrong beside its lens') if faults else found


def loss_of(given: Camera, solution: Solution, config: Config) -> float:
    """Return by how much the turns' cost grows when they must use a camera.

    given: of the solution's pictures. Poses and points are adjusted anew with each camera held.
    """
    from dashcalib_ros.solve.optimise import FIRST_TRACKS, loss_px_of, subsample_tracks
    from dashcalib_ros.solve.start import costs_with
    # a part of the tracks says it, and takes a fifth of the time
    scenes = [subsample_tracks(scene, FIRST_TRACKS) for scene in solution.scenes]
    loss_px = loss_px_of(scenes, solution.camera, config.intrinsics)
    own, other = (float(np.mean(costs_with(camera, scenes, loss_px, config.scene.error_px)))
                  for camera in (solution.camera, given))
    return other / own - 1


def _loss_text(loss: float) -> str:
    change = 'larger' if loss >= 0 else 'smaller'
    return (f'turns: their reprojection cost is {100 * abs(loss):.1f} % {change} with it than '
            f'with the camera that they determine, poses and points adjusted to each')


UNDECIDED = ('it differs from the camera that the turns determine, but explains the turns as '
                 'well: nothing decides between them')
# px; by so much the sides of pictures that were resized are rounded
ROUNDING_PX = 1.0
# of 1; nearer to it, parameters are not said to be for pictures of another size
LEAST_SCALE = 0.05
# pictures are mostly resized by a simple fraction: with so many parts, and if it is so near
MOST_PARTS = 4
SIMPLE = 0.01

# from here on lines do not agree with a camera, though they do not contradict it yet
DOUBT_SIGMAS = 2.0

Compare = Callable[[Camera], Difference]


def size_reason(given: Camera, image_size: tuple[int, int], compare: Compare | None,
                name: str = CALIBRATION) -> str:
    """Return what is wrong with a calibration for another size, and the command that resizes it.

    compare: with the drive's own solution; None where there is none. name: of its file.
    """
    width, height = image_size
    theirs = f'{given.image_size[0]}x{given.image_size[1]}'
    text = f'it is for {theirs} pictures, and those of the drive have {width}x{height}'
    if width != height and given.image_size == (height, width):
        return f'{text}: are width and height exchanged, or the pictures rotated by 90 degrees?'
    if same_shape(given.image_size, image_size):
        resize = export_command(name, f'--size {width}x{height}')
        if compare is None:
            return f'{text}; if the pictures were resized: {resize}'
        scaled = compare(given.resized(width / given.image_size[0], image_size))
        if scaled.answer == 'wrong':
            unscaled = compare(replace(given, image_size=image_size))
            return text + ('; scaled to that size, it is wrong, too' if unscaled.answer == 'wrong'
                           else f'; its parameters fit these as they are (to '
                                f'{unscaled.bound_px:.1f} px): only the size is wrong')
        return f'{text}; scaled to that size, it fits them (to {scaled.bound_px:.1f} px): {resize}'
    part = None if compare is None else _part(given, image_size, compare)
    if part is None:
        return text
    if min(part) < 0:
        return f'{text}; its focal length and distortion fit: it is for a part of these pictures'
    crop = export_command(name, f'--crop {part[0]},{part[1]},{width},{height}')
    return f'{text}; its focal length and distortion fit a part of its pictures: {crop}'


def same_shape(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Return whether pictures of (width, height) may be those of the other size, resized."""
    x, y = other[0] / one[0], other[1] / one[1]
    return abs(other[1] - x * one[1]) <= ROUNDING_PX or abs(other[0] - y * one[0]) <= ROUNDING_PX


def export_command(name: str, change: str) -> str:
    """Return the command that writes a calibration for other pictures. name: of its file."""
    return f'dashcalib export {quote(name)} --to ros {change} --out fitting.yaml'


def _part(given: Camera, image_size: tuple[int, int], compare: Compare) -> tuple[int, int] | None:
    """Return where the drive's pictures lie in the given camera's; None if they are not a part."""
    found = compare(replace(given, image_size=image_size))
    spare = np.subtract(given.image_size, image_size)
    x, y = (int(value) for value in np.clip(np.round(found.offsets[2:4]), np.minimum(spare, 0),
                                            np.maximum(spare, 0)))
    shifted = replace(given, image_size=image_size, cx=given.cx - x, cy=given.cy - y)
    return None if compare(shifted).answer == 'wrong' else (x, y)


def scaled_parameters(found: Difference, compare: Compare) -> str:
    """Return what is wrong where the parameters are for resized pictures; '' where they are not.

    The calibration says the drive's size, but its focal lengths and its centre do not fit it.
    """
    given, own = found.given, found.found
    ratios = [given.fx / own.fx, given.fy / own.fy, (given.cx + 0.5) / (own.cx + 0.5),
              (given.cy + 0.5) / (own.cy + 0.5)]
    factor = float(np.mean(ratios))
    simple = float(Fraction(factor).limit_denominator(MOST_PARTS))
    factor = simple if abs(simple / factor - 1) < SIMPLE else factor
    if abs(factor - 1) < LEAST_SCALE or np.ptp(ratios) > LEAST_SCALE * factor:
        return ''
    if compare(given.resized(1 / factor, given.image_size)).answer == 'wrong':
        return ''
    width, height = (round(side * factor) for side in given.image_size)
    return (f'its parameters are for pictures of {width}x{height}, but its size is '
            f'{given.image_size[0]}x{given.image_size[1]}')


def with_lines(found: Check, given: Camera, lines: Lines, image_size: tuple[int, int],
               config: Config) -> Check:
    """Return a check with what straight lines say about the given camera, if there are enough.

    lines: of the resized pictures. image_size: of the drive's. Lines alone call no camera wrong:
    where they contradict one that the turns call right, the drive cannot tell. One that differs
    they confirm, unless they find more than detection allows.
    """
    if given.image_size != image_size:
        return found
    scale = Scale.of(image_size, config)
    bent = bend(lines, given.resized(1 / scale.px, scale.size(image_size)))
    if bent is None:
        return found
    bent = bent.resized(scale.px)
    against = lines_contradict(bent, image_size[0], config.verdict)
    allowed = {'right': 0.0, 'differs': found.limits_px.get('detection', 0.0)}
    answer = ('cannot tell' if against and bent.picture_px > allowed.get(found.answer, np.inf)
              else found.answer)
    good_for = found.good_for if answer == found.answer else ()
    return replace(found, answer=answer, straight_lines=bent, good_for=good_for, reasons=(
        *found.reasons, _lines_text(bent, against, config.verdict.max_line_sigmas)))


def _lines_text(bent: Bend, against: bool, limit: float) -> str:
    what = ('contradict its distortion' if against else
            'do not fit its distortion, but too few pixels to decide' if bent.sigmas > limit else
            'lean against its distortion, but not enough to decide'
            if bent.sigmas > DOUBT_SIGMAS else 'agree with its distortion')
    return (f'{bent.lines} upright lines (poles, edges of houses) {what}: {bent.change}, '
            f'{bent.picture_px:.1f} px over the picture, {bent.sigmas:.1f} sigma, limit '
            f'{limit:.1f}')
