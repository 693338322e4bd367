"""The answer: right, wrong and in which way, or that the drive cannot tell."""
from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from dashcalib_ros.camera import Camera
from dashcalib_ros.config import Config
from dashcalib_ros.detect import Bend
from dashcalib_ros.input.scale import Scale
from dashcalib_ros.judge.calibration import Verdict
from dashcalib_ros.judge.difference import Difference, difference_of
from dashcalib_ros.judge.picture_size import scaled_parameters, size_reason
from dashcalib_ros.judge.wording import reasons_of
from dashcalib_ros.solve.knowledge import PictureSigma
from dashcalib_ros.solve.solution import Solution

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
    from dashcalib_ros.solve.fitting import FIRST_TRACKS, costs_with, subsample_tracks
    from dashcalib_ros.solve.prior import loss_px_of
    # a part of the tracks says it, and takes a fifth of the time
    scenes = [subsample_tracks(scene, FIRST_TRACKS) for scene in solution.scenes]
    loss_px = loss_px_of(scenes, solution.camera, config.intrinsics)
    own, other = (float(np.mean(costs_with(camera, scenes, loss_px, config.scene.error_px)))
                  for camera in (solution.camera, given))
    return other / own - 1


def _loss_text(loss: float) -> str:
    change = 'more' if loss >= 0 else 'less'
    return (f'with it the turns cost {100 * abs(loss):.1f} % {change} than with the camera they '
            f'ask for, poses and points adjusted anew to each')
