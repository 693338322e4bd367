"""A camera's own result as a JSON text, from which its calibration can be made again."""
from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera, camera_of
from dashcalib_ros.errors import InputError, one_line
from dashcalib_ros.fleet.fuse import ClipShare, Fused
from dashcalib_ros.judge import Calibration
from dashcalib_ros.report.result import calibration_of, plain_values, result_dict
from dashcalib_ros.solve.knowledge import PictureSigma

FORMAT = 2


@dataclass(frozen=True)
class Estimate:
    """A camera as its own turns have it, whatever the verdict, in px of the input.

    covariance: (n, n). of_its_noise: the same without what a single turn gets for how much turns
    differ: a make shows that better. sound: nothing but a lack of knowledge speaks against it.
    """

    camera: Camera
    covariance: Floats
    of_its_noise: Floats
    sigma_px: PictureSigma
    reprojection_error_px: float
    sound: bool


@dataclass(frozen=True)
class Solved:
    """A camera's result from its own clips. estimate: None where nothing was solved.

    shares: by clip.
    """

    camera: str
    make: str
    calibration: Calibration
    estimate: Estimate | None
    shares: Mapping[str, ClipShare]


def solved_of(camera: str, make: str, fused: Fused) -> Solved:
    """Return what is kept of a camera's fused clips."""
    calibration = replace(fused.calibration, input_name=camera)
    return Solved(camera, make, calibration, _estimate(fused), fused.shares)


def _estimate(fused: Fused) -> Estimate | None:
    solution = fused.solution
    if solution is None:
        return None
    px = fused.scale.px
    units = np.where(np.arange(len(solution.sigma)) < 4, px, 1.0)
    return Estimate(
        solution.camera.resized(px, fused.calibration.image_size),
        solution.covariance * np.outer(units, units),
        (solution.covariance - solution.known.covariance_between_turns) * np.outer(units, units),
        PictureSigma(solution.picture.rms * px, solution.picture.worst * px),
        solution.reprojection_error_px * px, fused.sound)


def encoded(solved: Solved) -> bytes:
    """Return the JSON text; the same result gives the same bytes."""
    estimate = solved.estimate
    data = plain_values({
        'format': FORMAT, 'camera': solved.camera, 'make': solved.make, 'shares': solved.shares,
        'estimate': None if estimate is None else {
            **vars(estimate), 'camera': None, 'model': estimate.camera.model,
            'params': estimate.camera.params, 'image_size': estimate.camera.image_size},
        # a make's prior moves the camera, and these are of the one before
        'calibration': result_dict(replace(solved.calibration, field=None, held_out=()))})
    return json.dumps(data, allow_nan=False, sort_keys=True).encode()


def decoded(data: bytes, name: str) -> Solved:
    """Return the result that a text holds; raises InputError, in which `name` names the file."""
    try:
        content = json.loads(data)
        if content['format'] != FORMAT:
            raise ValueError(f'it has format {content["format"]}, this version has {FORMAT}')
        estimate = _decoded_estimate(content['estimate'])
        return Solved(
            content['camera'], content['make'], _calibration(content['calibration'], estimate),
            estimate,
            {clip: ClipShare(**share) for clip, share in content['shares'].items()})
    except Exception as error:  # damaged files raise errors of all kinds
        raise InputError(f'{name} is no result of a camera ({one_line(error, 120)}); remove it, '
                         f'and the camera is solved again') from error


def _decoded_estimate(data: Mapping[str, Any] | None) -> Estimate | None:
    if data is None:
        return None
    camera = camera_of(data['model'], tuple(data['image_size']), data['params'])
    # JSON has no infinity: what was not finite is not known at all
    covariance, of_its_noise = (
        np.array([[np.inf if value is None else value for value in row] for row in table], float)
        for table in (data['covariance'], data.get('of_its_noise', data['covariance'])))
    return Estimate(camera, covariance, of_its_noise, _picture(data['sigma_px']),
                    data['reprojection_error_px'], data['sound'])


def _calibration(data: Mapping[str, Any], estimate: Estimate | None) -> Calibration:
    if estimate is None or data['verdict'] == 'refused':
        return calibration_of(data, None)
    return replace(calibration_of(data, estimate.camera),
                   sigma=sigmas(estimate.camera, estimate.covariance), sigma_px=estimate.sigma_px)


def sigmas(camera: Camera, covariance: Floats) -> dict[str, float]:
    """Return the standard deviations by the parameters' names."""
    return dict(zip(camera.names(), np.sqrt(np.diag(covariance)).tolist(), strict=True))


def _picture(data: Mapping[str, Any]) -> PictureSigma:
    return PictureSigma(*(np.inf if data[key] is None else data[key] for key in ('rms', 'worst')))
