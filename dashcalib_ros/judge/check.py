"""The answer: right, wrong and in which way, or that the drive cannot tell."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Literal

import numpy as np

from dashcalib_ros.camera import Camera
from dashcalib_ros.config import Config
from dashcalib_ros.detect import Bend, Lines, bend
from dashcalib_ros.input.scale import Scale
from dashcalib_ros.judge.calibration import Verdict
from dashcalib_ros.judge.difference import Difference, difference_of, reasons_of
from dashcalib_ros.judge.verdict import lines_contradict
from dashcalib_ros.solve.solution import Solution
from dashcalib_ros.solve.spread import PictureSigma

Answer = Literal['right', 'wrong', 'cannot tell']


@dataclass(frozen=True)
class Check:
    """What a drive says of a calibration that was given.

    answer: wrong means that neither chance nor what good calibrations differ by explains the
    difference; right, that the drive would have shown an error of 2 % in the focal length, or one
    as large in pixels. rms_px, worst_px: over the picture, between the given camera and the
    drive's own, the best common rotation removed; None where they cannot be compared. sigma_px:
    of the drive's own. told_apart: whether more than chance is between them. distance: of the
    given parameters from the nearest that good calibrations may have, in sigmas with all
    correlations; limit: what chance exceeds once in a thousand drives. loss: by how much worse the
    turns are explained when they must use the given camera, of the cost with their own; None where
    it was not tried. straight_lines: what they say of the given camera; None where there are too
    few.
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


def check(given: Camera, image_size: tuple[int, int], solution: Solution | None, verdict: Verdict,
          config: Config) -> Check:
    """Say whether a given camera explains a drive.

    image_size: of the drive's pictures. solution, verdict: of the drive; a solution that is not
    accepted neither confirms nor contradicts a calibration. Loads COLMAP.
    """
    if verdict.level != 'accepted' or solution is None:
        if given.image_size == image_size:
            return Check('cannot tell', tuple(
                f'the drive gives no calibration of its own: {text}' for text in verdict.reasons))
        return Check('wrong', (size_reason(given, image_size, None),))
    if not given.covers_picture():
        return Check('wrong', ('its distortion folds over inside the picture: points near its '
                               'corners are missing',))
    px = Scale.of(image_size, config).px

    def difference(camera: Camera) -> Difference:
        return difference_of(camera, solution, px)

    here = difference(replace(given, image_size=image_size))
    if given.image_size != image_size:
        # pixels of one size are no error in those of another
        return Check('wrong', (size_reason(given, image_size, difference),))
    loss = loss_of(given.resized(1 / px, solution.camera.image_size), solution, config)
    scaled = scaled_parameters(here, difference) if here.significant else ''
    reasons = (*((scaled,) if scaled else reasons_of(here)), _loss_text(loss))
    return Check(_answer(here, loss), reasons, here.rms_px, here.worst_px, here.sigma_px,
                 here.told_apart, here.distance, here.limit, loss)


def with_faults(found: Check, faults: tuple[str, ...]) -> Check:
    """Return a check with the faults of what stands beside the camera: with any, it is wrong."""
    return replace(found, answer='wrong', reasons=(*faults, *found.reasons)) if faults else found


def _answer(found: Difference, loss: float) -> Answer:
    if found.matters:
        # a calibration that explains the turns as well as their own is not contradicted by them
        return 'wrong' if loss > 0 else 'cannot tell'
    return 'cannot tell' if found.matters is None else 'right'


def loss_of(given: Camera, solution: Solution, config: Config) -> float:
    """Return by how much the turns' cost grows when they must use a camera.

    given: of the solution's pictures. Poses and points are adjusted anew with each camera held.
    """
    from dashcalib_ros.solve.prior import loss_px_of
    from dashcalib_ros.solve.start import costs_with, with_few_tracks
    # a part of the tracks says it, and takes a fifth of the time
    scenes = list(map(with_few_tracks, solution.scenes))
    loss_px = loss_px_of(scenes, solution.camera, config.intrinsics)
    own, other = (float(np.mean(costs_with(camera, scenes, loss_px, config.scene.error_px)))
                  for camera in (solution.camera, given))
    return other / own - 1


def _loss_text(loss: float) -> str:
    change = 'more' if loss >= 0 else 'less'
    return (f'with it the turns cost {100 * abs(loss):.1f} % {change} than with the camera they '
            f'ask for, poses and points adjusted anew to each')


# of the ratio of the sides; pictures that were resized keep it but for rounding
SAME_ASPECT = 0.01
# of 1; nearer to it, parameters are not said to be for pictures of another size
LEAST_SCALE = 0.05
# pictures are mostly resized by a simple fraction: with so many parts, and if it is so near
MOST_PARTS = 4
SIMPLE = 0.01

Compare = Callable[[Camera], Difference]


def size_reason(given: Camera, image_size: tuple[int, int], compare: Compare | None) -> str:
    """Return what is wrong with a calibration for another size.

    compare: with the drive's own solution; None where there is none.
    """
    width, height = image_size
    theirs = f'{given.image_size[0]}x{given.image_size[1]}'
    text = f'it is for {theirs} pictures, and those of the drive have {width}x{height}'
    if width != height and given.image_size == (height, width):
        return f'{text}: are width and height exchanged, or the pictures turned by 90 degrees?'
    factor = width / given.image_size[0]
    if abs(height / given.image_size[1] / factor - 1) <= SAME_ASPECT:
        if compare is None:
            return text
        scaled = compare(given.resized(factor, image_size))
        if scaled.significant:
            unscaled = compare(replace(given, image_size=image_size))
            return text + ('; scaled to that size, it is wrong, too' if unscaled.significant else
                           f'; its parameters fit these as they are (to {unscaled.bound_px:.1f} '
                           f'px): only the size is wrong')
        return (f'{text}; scaled to that size, it fits them (to {scaled.bound_px:.1f} px): '
                f'dashcalib export --size {width}x{height}')
    part = None if compare is None else _part(given, image_size, compare)
    if part is None:
        return text
    if min(part) < 0:
        return f'{text}; its focal length and distortion fit: it is for a part of these pictures'
    return (f'{text}; its focal length and distortion fit a part of its pictures: dashcalib '
            f'export --crop {part[0]},{part[1]},{width},{height}')


def _part(given: Camera, image_size: tuple[int, int], compare: Compare) -> tuple[int, int] | None:
    """Return where the drive's pictures lie in the given camera's; None if they are no part."""
    found = compare(replace(given, image_size=image_size))
    spare = np.subtract(given.image_size, image_size)
    x, y = (int(value) for value in np.clip(np.round(found.offsets[2:4]), np.minimum(spare, 0),
                                            np.maximum(spare, 0)))
    shifted = replace(given, image_size=image_size, cx=given.cx - x, cy=given.cy - y)
    return None if compare(shifted).significant else (x, y)


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
    if compare(given.resized(1 / factor, given.image_size)).significant:
        return ''
    width, height = (round(side * factor) for side in given.image_size)
    return (f'its parameters are for pictures of {width}x{height}, and it says '
            f'{given.image_size[0]}x{given.image_size[1]}')


def with_lines(found: Check, given: Camera, lines: Lines, image_size: tuple[int, int],
               config: Config) -> Check:
    """Return a check with what straight lines say of the given camera, if there are enough.

    lines: of the resized pictures. image_size: of the drive's. Lines alone call no camera wrong:
    where they contradict one that the turns call right, the drive cannot tell.
    """
    if given.image_size != image_size:
        return found
    scale = Scale.of(image_size, config)
    said = bend(lines, given.resized(1 / scale.px, scale.size(image_size)), config.lines)
    if said is None:
        return found
    said = said.resized(scale.px)
    against = lines_contradict(said, image_size[0], config.verdict)
    answer = 'cannot tell' if against and found.answer == 'right' else found.answer
    return replace(found, answer=answer, reasons=(*found.reasons, _text(said, against)),
                   straight_lines=said)


def _text(said: Bend, against: bool) -> str:
    return (f'{said.lines} upright lines (poles, edges of houses) '
            f'{"contradict" if against else "do not contradict"} its distortion: they ask for k1 '
            f'{said.k1:+.3f} ± {said.sigma:.3f}')
