# SPDX-License-Identifier: Apache-2.0
"""A camera's own result, as a JSON text; with the prior of its model, the final calibration."""
from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera, camera_of
from dashcalib_ros.camera.mapping import sensitivity
from dashcalib_ros.errors import InputError, Notice, coded, one_line
from dashcalib_ros.fleet import lens_prior
from dashcalib_ros.fleet.lens_prior import LensPrior, ModelPrior, Unit, conditioned
from dashcalib_ros.formats import result_dict
from dashcalib_ros.formats.ours import calibration_of
from dashcalib_ros.judge import CalibrationData, Verdict
from dashcalib_ros.judge.calibration import Condition
from dashcalib_ros.solve.spread import PictureSigma

# of the JSON text
FORMAT = 6


@dataclass(frozen=True)
class ClipShare:
    """What a clip gave to its camera's calibration.

    used: turns in the adjustment. left_out: why none is, '' otherwise; code: of that. fx,
    fx_sigma: of its turns alone, in px of the input, linearised at the camera's solution; None
    where unknown. The sigma is that of their noise, without how much turns differ beyond it.
    sigma_so_far: of fx by this clip and all before it, by name; as the camera's.
    """

    used: int = 0
    left_out: str = ''
    code: str = ''
    fx: float | None = None
    fx_sigma: float | None = None
    sigma_so_far: float | None = None

    @classmethod
    def without(cls, why: Notice) -> ClipShare:
        """Return the share of a clip that is left out."""
        return cls(left_out=coded(why), code=why.code)


@dataclass(frozen=True)
class Estimate:
    """A camera as its own turns have it, whatever the verdict, in px of the input.

    covariance: (n, n). of_its_noise: the same without what a single turn gets for how much turns
    differ: the other units of its model show that better. sound: nothing but a lack of knowledge
    speaks against it: a prior of its model may help.
    """

    camera: Camera
    covariance: Floats
    of_its_noise: Floats
    sigma_px: PictureSigma
    reprojection_error_px: float
    sound: bool

    @property
    def sigma(self) -> dict[str, float]:
        """Return the standard deviations by the parameters' names."""
        return sigmas(self.camera, self.covariance)


@dataclass(frozen=True)
class Solved:
    """A camera's result from its own clips. estimate: None where nothing was solved.

    shares: by clip.
    """

    camera: str
    camera_model: str
    calibration: CalibrationData
    estimate: Estimate | None
    shares: Mapping[str, ClipShare]


def encoded(solved: Solved) -> bytes:
    """Return the JSON text; the same result gives the same bytes."""
    estimate = solved.estimate
    return json.dumps({
        'camera': solved.camera, 'camera_model': solved.camera_model, 'shares': solved.shares,
        'estimate': None if estimate is None else {**vars(estimate), 'camera': (
            estimate.camera.model, estimate.camera.image_size, estimate.camera.params)},
        # the prior moves the camera, and these are of the one before
        'calibration': result_dict(replace(solved.calibration, field=None, held_out=()))},
        sort_keys=True, default=_plain).encode()


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else vars(value)


def decoded(data: bytes, name: str) -> Solved:
    """Return the result that a text holds; raises InputError, in which `name` names the file."""
    try:
        content = json.loads(data)
        own, estimate, camera = content['calibration'], None, None
        if content['estimate'] is not None:
            estimate = _estimate(**content['estimate'])
            camera = estimate.camera if own['verdict'] != 'refused' else None
        calibration = calibration_of(own, camera)
        if estimate is not None and camera is not None:
            # in which what is not known is infinite
            calibration = replace(calibration, sigma=estimate.sigma, sigma_px=estimate.sigma_px)
        return Solved(
            content['camera'], content['camera_model'], calibration, estimate,
            {clip: ClipShare(**share) for clip, share in content['shares'].items()})
    except Exception as error:  # damaged files raise errors of all kinds
        raise InputError('E-FLEET-FILE-DAMAGED',
                         f'{name} is not the result of a camera ({one_line(error, 120)}); remove '
                         f'it, and the next run solves the camera again') from error


def _estimate(camera: tuple[str, list[int], list[float]], covariance: list[list[float]],
              of_its_noise: list[list[float]], sigma_px: dict[str, float], **others: Any
              ) -> Estimate:
    model, (width, height), params = camera
    return Estimate(camera_of(model, (width, height), params), np.array(covariance),
                    np.array(of_its_noise), PictureSigma(**sigma_px), **others)


def sigmas(camera: Camera, covariance: Floats) -> dict[str, float]:
    """Return the standard deviations by the parameters' names."""
    return dict(zip(camera.names(), np.sqrt(np.diag(covariance)).tolist(), strict=True))


@dataclass(frozen=True)
class Final:
    """A camera's result with the prior of its model, where there is one.

    prior_units: cameras that the prior is made from; prior_share: of the information about fx that
    it gave. prior_note: why there is none, '' if there is. other_mode: it is in another mode.
    """

    calibration: CalibrationData
    prior_units: int = 0
    prior_share: float = 0.0
    prior_note: str = ''
    other_mode: bool = False


def unit_of(solved: Solved) -> Unit | None:
    """Return what a camera adds to the prior of its model; None where it cannot be trusted."""
    estimate = solved.estimate
    if (estimate is None or not solved.camera_model or not estimate.sound
            or not np.isfinite(estimate.of_its_noise).all()):
        return None
    return lens_prior.unit_of(
        solved.camera, solved.camera_model, estimate.camera, estimate.of_its_noise,
        sum(share.used for share in solved.shares.values()) == 1)


def final_of(solved: Solved, found: ModelPrior | None) -> Final:
    """Return the camera's result with the prior that was found for its model."""
    own = solved.calibration
    if found is None:
        return Final(own, prior_note='its own turns give no estimate to combine with a prior'
                     if solved.camera_model else
                     'the model of the camera is unknown (column camera_model)')
    if found.prior is not None:
        return _with_prior(solved, found.prior)
    if found.other_mode:
        own = replace(own, warnings=(*own.warnings, Notice(
            'E-PRIOR-OTHER-MODE', f'camera model {solved.camera_model}: {found.why_not}')))
    return Final(own, prior_note=found.why_not, other_mode=found.other_mode)


def _with_prior(solved: Solved, prior: LensPrior) -> Final:
    own, estimate, unit = solved.calibration, solved.estimate, unit_of(solved)
    assert estimate is not None and unit is not None
    own_covariance = prior.excess_of(unit) * estimate.of_its_noise
    camera, covariance = conditioned(estimate.camera, own_covariance, prior)
    share = float(1 - covariance[0, 0] / own_covariance[0, 0]
                  * (estimate.camera.fx / camera.fx)**2)
    calibration = replace(
        own, verdict=_verdict(own, solved.camera_model, camera, covariance, prior, share),
        camera=camera, sigma=sigmas(camera, covariance),
        reprojection_error_px=estimate.reprojection_error_px,
        sigma_px=_picture_sigma(camera, covariance, estimate.sigma_px),
        covariance=covariance, picture_covariance=covariance,
        details={**own.details, 'prior': {
            'camera_model': solved.camera_model, 'units': prior.units, 'share_of_fx': share,
            'fx_alone': estimate.camera.fx, 'sigma_alone': estimate.sigma}})
    return Final(calibration, prior.units, share)


def _verdict(own: CalibrationData, camera_model: str, camera: Camera, covariance: Floats,
             prior: LensPrior, share: float) -> Verdict:
    """Return the verdict with a prior: it never makes a result accepted."""
    if own.verdict.level == 'accepted':
        return own.verdict
    sigma = 100 * float(np.sqrt(covariance[0, 0])) / camera.fx
    why = Notice(
        'E-PRIOR-USED', f'{100 * share:.0f} % of the information about fx comes from the prior of '
        f'the camera model {camera_model} ({prior.units} other cameras), the rest from its own '
        f'turns; sigma of fx with it: {sigma:.1f} %')
    return Verdict('weak', (why, *(
        Notice(each.code, f'without the prior: {each}') for each in own.verdict.reasons)),
        (Condition(why.code, str(why), '', '', False), *own.verdict.conditions))


def _picture_sigma(camera: Camera, covariance: Floats, alone: PictureSigma) -> PictureSigma:
    """Return the sigma over the picture; a prior never makes it larger."""
    moves, _ = sensitivity(camera)
    variances = np.einsum('mij,jk,mik->m', moves, covariance, moves)
    return PictureSigma(min(float(np.sqrt(variances.mean())), alone.rms),
                        min(float(np.sqrt(variances.max())), alone.worst))
