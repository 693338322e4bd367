"""A camera's own result, as a JSON text; with the prior of its make, the final calibration.

Estimate and prior are normal distributions, the estimate linearised at the unit's own solution, in
the curvature of the focal lengths (lens_prior.py): one step of conditioning.
"""
from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera, camera_of
from dashcalib_ros.camera.mapping import sensitivity
from dashcalib_ros.errors import InputError, one_line
from dashcalib_ros.fleet.fuse import ClipShare, Fused
from dashcalib_ros.fleet.lens_prior import LensPrior, Unit, curvature, focal_length
from dashcalib_ros.fleet.lens_prior import Verdict as PriorVerdict
from dashcalib_ros.judge import Calibration, Verdict
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
    units = solution.camera.units(px)
    return Estimate(
        solution.camera.resized(px, fused.calibration.image_size),
        solution.covariance * np.outer(units, units),
        (solution.covariance - solution.known.covariance_between_turns) * np.outer(units, units),
        solution.picture.times(px),
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


# of the information about fx; with more the prior decided, not the camera's own turns
DECIDES = 0.5


@dataclass(frozen=True)
class Final:
    """A camera's result. sigma_alone: without the prior; both None where there is no estimate.

    prior_units: cameras that the prior is made from, 0 without one; prior_share: of the
    information about fx that it gave. prior_note: why there is none, '' if there is.
    """

    calibration: Calibration
    verdict_alone: str
    sigma_alone: Mapping[str, float] | None = None
    prior_units: int = 0
    prior_share: float = 0.0
    prior_note: str = ''
    other_mode: bool = False
    covariance: Floats | None = field(default=None, repr=False)


def unit_of(solved: Solved) -> Unit | None:
    """Return what a camera tells of its make; None where it tells nothing that can be trusted."""
    estimate = solved.estimate
    if estimate is None or not solved.make or not estimate.sound:
        return None
    if not np.isfinite(estimate.of_its_noise).all():
        return None
    lens, covariance = _in_units_of_prior(estimate.camera, estimate.of_its_noise)
    which = _lens_places(len(lens))
    size = estimate.camera.image_size
    return Unit(solved.camera, (solved.make, f'{size[0]}x{size[1]}', estimate.camera.model),
                lens[which], covariance[np.ix_(which, which)],
                sum(share.used for share in solved.shares.values()) == 1)


def final_of(solved: Solved, found: PriorVerdict | None) -> Final:
    """Return the camera's result with the prior of its make, if there is one for it."""
    own = solved.calibration
    estimate = solved.estimate
    alone = None if estimate is None else sigmas(estimate.camera, estimate.covariance)
    result = Final(own, own.verdict.level, alone,
                   covariance=None if estimate is None else estimate.covariance)
    if found is None or estimate is None:
        return replace(result, prior_note=_why_none(solved))
    if found.prior is None:
        result = replace(result, prior_note=found.why_not, other_mode=found.other_mode)
        if not found.other_mode:
            return result
        return replace(result, calibration=replace(
            own, warnings=(*own.warnings, f'the make {solved.make}: {found.why_not}')))
    return _with_prior(result, solved, estimate, found.prior)


def _why_none(solved: Solved) -> str:
    if not solved.make:
        return 'its make is not known'
    return 'it has no estimate of its own that could be combined with one'


def _with_prior(result: Final, solved: Solved, estimate: Estimate, prior: LensPrior) -> Final:
    unit = unit_of(solved)
    assert unit is not None
    own_covariance = prior.excess_of(unit) * estimate.of_its_noise
    camera, covariance = conditioned(estimate.camera, own_covariance, prior)
    share = float(1 - covariance[0, 0] / own_covariance[0, 0]
                  * (estimate.camera.fx / camera.fx)**2)
    own = result.calibration
    return replace(
        result, prior_units=prior.units, prior_share=share, covariance=covariance,
        calibration=replace(
            own, verdict=_verdict(own, solved.make, camera, covariance, prior, share),
            camera=camera, sigma=sigmas(camera, covariance),
            reprojection_error_px=estimate.reprojection_error_px,
            sigma_px=_picture_sigma(camera, covariance, estimate.sigma_px),
            details={**own.details, 'picture_covariance': covariance.tolist(), 'prior': {
                'make': solved.make, 'units': prior.units, 'share_of_fx': share,
                'fx_alone': estimate.camera.fx,
                'sigma_alone': sigmas(estimate.camera, estimate.covariance)}}))


def _verdict(own: Calibration, make: str, camera: Camera, covariance: Floats, prior: LensPrior,
             share: float) -> Verdict:
    """Return the verdict with a prior: it never makes a result accepted."""
    if own.verdict.level == 'accepted':
        return own.verdict
    sigma = 100 * float(np.sqrt(covariance[0, 0])) / camera.fx
    what = 'decided' if share > DECIDES else 'took part'
    return Verdict('weak', (
        f'the prior of the make {make}, from {prior.units} other cameras, {what}: it gave '
        f'{100 * share:.0f} % of the information about fx (sigma {sigma:.1f} % with it)',
        *(f'alone: {reason}' for reason in own.verdict.reasons)))


def conditioned(camera: Camera, covariance: Floats, prior: LensPrior) -> tuple[Camera, Floats]:
    """Return the camera and its covariance (n, n) after the prior."""
    values, spread = _in_units_of_prior(camera, covariance)
    which = _lens_places(len(values))
    gain = spread[:, which] @ np.linalg.inv(spread[np.ix_(which, which)] + prior.covariance)
    values = values + gain @ (prior.mean - values[which])
    keep = np.eye(len(values))
    keep[:, which] -= gain
    # Joseph's form stays positive
    spread = keep @ spread @ keep.T + gain @ prior.covariance @ gain.T
    params = values * _scales(camera)
    params[:2] = focal_length(values[:2]) * camera.image_size[0]
    moved = camera.with_params(params)
    back = _slopes(moved)
    return moved, spread / np.outer(back, back)


def _in_units_of_prior(camera: Camera, covariance: Floats) -> tuple[Floats, Floats]:
    """Return the curvatures, cx/w, cy/w and the coefficients, and their covariance."""
    values = camera.params / _scales(camera)
    values[:2] = curvature(values[:2])
    slopes = _slopes(camera)
    return values, covariance * np.outer(slopes, slopes)


def _scales(camera: Camera) -> Floats:
    scales = np.ones(len(camera.params))
    scales[:4] = camera.image_size[0]
    return scales


def _slopes(camera: Camera) -> Floats:
    """Return the derivatives (n,) of the prior's values by the camera's parameters."""
    slopes = 1 / _scales(camera)
    slopes[:2] = camera.image_size[0]**2 / camera.params[:2]**3
    return np.asarray(slopes)


def _lens_places(count: int) -> list[int]:
    """Return the places of what units of a model share: the focal length, the distortion."""
    return [0, *range(4, count)]


def _picture_sigma(camera: Camera, covariance: Floats, alone: PictureSigma) -> PictureSigma:
    """Return the sigma over the picture; a prior never makes it larger."""
    moves, _ = sensitivity(camera)
    variances = np.einsum('mij,jk,mik->m', moves, covariance, moves)
    return PictureSigma(min(float(np.sqrt(variances.mean())), alone.rms),
                        min(float(np.sqrt(variances.max())), alone.worst))
