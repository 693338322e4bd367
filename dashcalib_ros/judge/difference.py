# SPDX-License-Identifier: Apache-2.0
"""How far two calibrations are apart, in one scale: the same, good enough for some uses, wrong.

One answer for `check`, where a given camera meets a drive's own, and for `compare`, where two
files meet. The camera that was found is a normal distribution of its n parameters. The other is a
point among them, at a Mahalanobis distance that chance explains or not: that decides whether they
are the same. How far they are apart over the picture, beside what each use of a camera allows,
decides whether the difference is good enough or wrong. Which parameters make it is found by
omitting them: how far the rest alone is from its own distribution.
"""
from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as default
from functools import cached_property
from typing import Any, Literal

import numpy as np

from dashcalib_ros.arrays import Floats, plain_values
from dashcalib_ros.camera import Camera, misread
from dashcalib_ros.camera.field import Field
from dashcalib_ros.camera.mapping import Apart, apart, as_model, sensitivity
from dashcalib_ros.errors import InputError, Notice
from dashcalib_ros.judge.calibration import Drift, Mount
from dashcalib_ros.solve.solution import Solution
from dashcalib_ros.solve.spread import PictureSigma, SigmaMap, sigma_over

Way = Literal['focal length', 'centre', 'distortion']
# the first parameters of every camera; all behind them are of the distortion
PLACES: dict[Way, tuple[int, ...]] = {'focal length': (0, 1), 'centre': (2, 3)}
Answer = Literal['right', 'differs', 'wrong', 'cannot tell']
Use = Literal['detection', 'mapping', 'metrology']
# what each use allows: as much, over the picture, as an error of the focal length by this share
USES: dict[Use, float] = {
    # the distance of a car by its size is off by the same share; its box is good to 2 or 3 %
    'detection': 0.01,
    # two calibrations that KITTI ships for one lens differ by 0.4 %; with 0.3 % of distortion in
    # one of them, the scale of a path of 559 m drifts by 44 % instead of 9 %
    'mapping': 0.0025,
    # what a calibration with a chessboard reaches: 0.1 to 0.3 px
    'metrology': 0.0005}
# with 95 % confidence the error must be below this many times what the use allows
SURE = 2.0
# of the focal length: a drive that calls a camera right must be able to see what this one makes
RELEVANT = SURE * USES['detection']
# of the width: a centre that is shown to be farther off turns every direction by half a degree
CENTRE = 0.01
# how often chance alone exceeds the limit of a distance
CHANCE = 1e-3
# px; a smaller sigma is none
LEAST_SIGMA_PX = 1e-9
# no direction of the parameters is known better over the picture: px, and of its sigma. Errors of
# tracks that all turns share move directions that seem known to 0.01 px by 0.02, with lenses of
# 120 degrees by more; without this floor four of 26 true cameras of check.py differed
FLOOR_PX, FLOOR_SHARE = 0.01, 0.03


@dataclass(frozen=True, eq=False)
class Difference:
    """A given camera beside one that was found, in px of the same pictures.

    offsets: (n,) given minus found, in the parameters of a model that has both; covariance: (n, n)
    of them; None where neither is known. apart: how far both see a ray; None where they cannot be
    compared. sigma_px: of what is known about both, over the picture.
    """

    given: Camera
    found: Camera
    offsets: Floats
    covariance: Floats | None
    apart: Apart | None
    sigma_px: PictureSigma | None

    @property
    def limit(self) -> float:
        """Return the distance that chance alone exceeds once in a thousand drives, in sigmas."""
        return limit_of(len(self.offsets))

    @cached_property
    def distance(self) -> float | None:
        """Return by how many sigmas they differ; None where no sigma is known.

        The Mahalanobis distance of the parameters, or the distance over the picture where that is
        larger: two models may differ where no parameter does.
        """
        if self.covariance is None or self.sigma_px is None:
            return None
        return max(distance(self.offsets, self.covariance),
                   np.inf if self.rms_px is None
                   else self.rms_px / max(self.sigma_px.rms, LEAST_SIGMA_PX))

    @property
    def told_apart(self) -> bool | None:
        """Return whether more than chance is between them; None where no sigma is known."""
        return None if self.distance is None else not self.distance <= self.limit

    @property
    def answer(self) -> Answer:
        """Return what the distance and the pixels say.

        right: chance explains the difference, and it is small enough for detection. differs: it is
        real, and small enough. wrong: it is real, and larger than detection allows. cannot tell:
        the error may be too large, and nothing shows whether it is.
        """
        if self._wrong:
            return 'wrong'
        if not self.good_for:
            return 'cannot tell'
        return 'right' if self._same else 'differs'

    @property
    def _same(self) -> bool:
        return (self.rms_px is not None and self.rms_px <= self.limits_px['metrology']
                if self.told_apart is None else not self.told_apart)

    @property
    def _wrong(self) -> bool:
        return not self._same and (self.centre_off or self.rms_px is None
                                   or self.rms_px > self.limits_px['detection'])

    @property
    def matters(self) -> bool | None:
        """Return whether the difference is too large for every use; None where nothing tells."""
        return None if self.answer == 'cannot tell' else self.answer == 'wrong'

    @property
    def good_for(self) -> tuple[Use, ...]:
        """Return for which uses the given camera is near enough to the one that was found."""
        return () if self._wrong or self.rms_px is None else tuple(
            use for use, limit in self.limits_px.items()
            if self.rms_px <= limit and self.bound_px <= SURE * limit)

    @property
    def centre_off(self) -> bool:
        """Return whether the centre is shown to be farther off than CENTRE.

        Over the picture hardly anything of it is seen: it looks like a camera that is turned.
        """
        sigma = (np.zeros(2) if self.covariance is None
                 else np.sqrt(np.diag(self.covariance)[2:4]))
        return bool(np.max(np.abs(self.offsets[2:4]) - 2 * sigma)
                    > CENTRE * self.given.image_size[0])

    @property
    def rms_px(self) -> float | None:
        """Return how far apart they are over the picture."""
        return None if self.apart is None else self.apart.rms

    @property
    def worst_px(self) -> float | None:
        """Return how far apart they are where it is most."""
        return None if self.apart is None else self.apart.worst

    @property
    def bound_px(self) -> float:
        """Return what the given camera's error over the picture stays below with 95 %."""
        sigma = 0.0 if self.sigma_px is None else self.sigma_px.rms
        return np.inf if self.rms_px is None else self.rms_px + 2 * sigma

    @cached_property
    def limits_px(self) -> Mapping[Use, float]:
        """Return how far apart, over the picture, each use allows the cameras to be."""
        moves, _ = sensitivity(self.found)
        longer = self.found.params * (np.arange(len(self.found.params)) < 2)
        whole = float(np.sqrt(np.mean(np.sum((moves @ longer)**2, axis=1))))
        return {use: share * whole for use, share in USES.items()}

    @property
    def sigma_map(self) -> SigmaMap | None:
        """Return the sigma of the difference at the pixels of a grid over the picture."""
        if self.covariance is None:
            return None
        model = self.found if len(self.found.params) == len(self.offsets) else self.given
        moves, pixels = sensitivity(model)
        return SigmaMap(pixels, sigma_over(moves, self.covariance))

    def ways(self) -> Mapping[Way, tuple[Floats, Floats]]:
        """Return the fewest parts of the camera that explain the distance, the largest first.

        Each with its offsets that are left when the other parts are as the drive says, and their
        sigmas.
        """
        left: list[Way] = ['focal length', 'centre', 'distortion']
        chosen: list[Way] = []
        while left:
            chosen.append(min(left, key=lambda way: self._without([*chosen, way])))
            left.remove(chosen[-1])
            count = len(self.offsets) - len(self._places(chosen))
            if self._without(chosen) <= limit_of(count):
                break
        assert self.covariance is not None
        places = np.array(self._places(chosen))
        rest = np.setdiff1d(np.arange(len(self.offsets)), places)
        # what the rest, as it is given, leads one to expect of the chosen parts
        across = self.covariance[np.ix_(places, rest)]
        follow = np.linalg.solve(self.covariance[np.ix_(rest, rest)], across.T).T
        offsets = self.offsets[places] - follow @ self.offsets[rest]
        sigmas = np.sqrt(np.diag(self.covariance[np.ix_(places, places)] - follow @ across.T))
        own = {way: np.isin(places, self._places([way])) for way in chosen}
        return {way: (offsets[mine], sigmas[mine]) for way, mine in own.items()}

    def _without(self, ways: Sequence[Way]) -> float:
        assert self.covariance is not None
        rest = np.setdiff1d(np.arange(len(self.offsets)), self._places(ways))
        return distance(self.offsets[rest], self.covariance[np.ix_(rest, rest)])

    def _places(self, ways: Sequence[Way]) -> list[int]:
        count = len(self.offsets)
        return [place for way in ways for place in PLACES.get(way, range(4, count))]


def limit_of(count: int) -> float:
    """Return the Mahalanobis distance of so many parameters that chance exceeds by CHANCE."""
    from scipy import special
    return float(np.sqrt(special.chdtri(count, CHANCE))) if count else 0.0


def distance(offsets: Floats, covariance: Floats) -> float:
    """Return the Mahalanobis distance of offsets (n,) of this covariance (n, n); 0 for none."""
    if not len(offsets):
        return 0.0
    return float(np.linalg.norm(np.linalg.solve(np.linalg.cholesky(covariance), offsets)))


def difference_of(given: Camera, solution: Solution, px: float) -> Difference:
    """Compare a camera with a solution.

    given: of the input's pictures. px: of the input, in one pixel of the solution's pictures.
    """
    found = solution.camera
    small = given.resized(1 / px, found.image_size)
    wide = found.widened()
    alike = small if isinstance(wide, type(small)) else as_model(small, type(wide))
    padded = type(wide).of(wide.image_size, np.pad(
        alike.params, (0, len(wide.params) - len(alike.params))))
    offsets = solution.seen_by_turns(padded) - found.params
    units = found.units(px)
    own, sigma_px = found.resized(px, given.image_size), solution.picture.times(px)
    return Difference(
        given, own, offsets * units,
        _with_floor(own, solution.covariance * np.outer(units, units), sigma_px),
        apart(given, own), sigma_px)


def _with_floor(camera: Camera, covariance: Floats, sigma_px: PictureSigma) -> Floats:
    """Return a camera's covariance (n, n) with the least variance of each direction added."""
    moves, _ = sensitivity(camera)
    each = np.einsum('mai,maj->ij', moves, moves) / len(moves)
    # some parameters hardly move the picture
    scale = 1 / np.sqrt(np.maximum(np.diag(each), LEAST_SIGMA_PX**2))
    units = np.linalg.pinv(each * np.outer(scale, scale), hermitian=True) * np.outer(scale, scale)
    return np.asarray(covariance + (FLOOR_PX**2 + (FLOOR_SHARE * sigma_px.rms)**2) * units)


@dataclass(frozen=True)
class NamedCamera:
    """A camera as a file or a truth has it, with its name, sigma and verdict.

    name: where it is from, for messages. sigma: by the parameters' names; None unless all are
    known. verdict: accepted or weak; None where the file has none (a truth, another tool's file).
    covariance: (n, n) of the parameters, as the picture shows them, and sigma_px: over the
    picture; None where the file does not say.
    field: what its lens model leaves over, where a result.json has one that is used. mount: how it
    sits on the car, where the file says. readout_ms: of a rolling shutter, from the first row to
    the last; None where the file has none. drift, temperature_c: as CalibrationData's.
    faults: in words, of what else stands beside the camera (ROS's K, R and P). warnings: of what
    is odd in the camera itself.
    """

    name: str
    camera: Camera
    sigma: Mapping[str, float] | None = default(default=None, hash=False)
    verdict: str | None = None
    covariance: Floats | None = default(default=None, compare=False)
    sigma_px: PictureSigma | None = None
    field: Field | None = default(default=None, compare=False)
    mount: Mount | None = default(default=None, compare=False)
    readout_ms: float | None = default(default=None, compare=False)
    faults: tuple[str, ...] = ()
    warnings: tuple[Notice, ...] = default(default=(), compare=False)
    drift: Drift | None = default(default=None, compare=False)
    temperature_c: float | None = default(default=None, compare=False)

    def at_temperature(self, now_c: float) -> Camera:
        """Return the camera at a temperature, degrees Celsius, but no farther than was seen.

        The same one where its focal length is not known to follow the temperature.
        """
        drift, of_c = self.drift, self.temperature_c
        if drift is None or of_c is None or drift.from_c is None or drift.to_c is None:
            return self.camera
        return self.camera.zoomed(drift.zoom(min(max(now_c, drift.from_c), drift.to_c) - of_c))

    def without_faults(self) -> NamedCamera:
        """Return it; raises InputError where something beside the camera is wrong."""
        if self.faults:
            raise InputError('E-CAMERA-FAULTS',
                             f'{self.name}: {"; ".join(self.faults)}; no supported camera model '
                             f'has that: correct the file')
        return self

    @property
    def image_size(self) -> tuple[int, int]:
        """Return (width, height) in pixels."""
        return self.camera.image_size

    def to_dict(self) -> dict[str, Any]:
        """Return it as dicts, lists, text, finite numbers and None."""
        values: dict[str, Any] = plain_values(self)
        return {**values, 'camera': {'model': self.camera.model, **values['camera']}}


def difference_between(given: NamedCamera, found: NamedCamera) -> Difference:
    """Compare two cameras, knowing only what their files say."""
    # in the parameters of one whose covariance is known, so that theirs together has full rank
    base = found if found.covariance is not None else given
    a, b = (each.camera if type(each.camera) is type(base.camera)
            else as_model(each.camera, type(base.camera)) for each in (given, found))
    covariances = [_carried(each.covariance, each.camera, base.camera)
                   for each in (given, found) if each.covariance is not None]
    sigmas = [each.sigma_px for each in (given, found) if each.sigma_px is not None]
    sigma_px = PictureSigma(
        float(np.hypot.reduce([each.rms for each in sigmas])),
        float(np.hypot.reduce([each.worst for each in sigmas]))) if sigmas else None
    return Difference(
        given.camera, found.camera, a.params - b.params,
        _with_floor(base.camera, np.sum(covariances, axis=0), sigma_px)
        if covariances and sigma_px is not None else None,
        apart(given.camera, found.camera,
              None if given.field is None else given.field.observed,
              None if found.field is None else found.field.ideal), sigma_px)


def _carried(covariance: Floats, camera: Camera, to: Camera) -> Floats:
    """Return what a camera's covariance is in the parameters of another model."""
    if type(camera) is type(to):
        return covariance
    (moves, pixels), (others, also) = sensitivity(camera), sensitivity(to)
    mine, theirs = np.nonzero((pixels[:, None] == also).all(axis=2))
    carry, *_ = np.linalg.lstsq(others[theirs].reshape(-1, others.shape[2]),
                                moves[mine].reshape(-1, moves.shape[2]), rcond=None)
    return np.asarray(carry @ covariance @ carry.T)


# of the distance; a camera read as one of the other family that is so much nearer is that one
NEARER = 0.5


def misread_text(given: Camera, rms_px: float | None, compare: Callable[[Camera], Difference]
                 ) -> str:
    """Return that a file has the wrong distortion model, where its numbers fit as the other one.

    rms_px: between the given camera and the one that was found. compare: with that one.
    """
    other = misread(given)
    read = None if other is None else compare(other)
    if other is None or read is None or read.rms_px is None or not read.good_for or (
            rms_px is not None and read.rms_px > NEARER * rms_px):
        return ''
    return (f'its distortion model may be wrong: read as {other.ros_model} instead of '
            f'{given.ros_model}, it differs by {read.rms_px:.2f} px RMS')


# of the width; a centre that is farther off looks like that of a part of the picture
CROPPED = 0.04


def answers_of(found: Difference, whose: str) -> tuple[str, ...]:
    """Return what a difference says, with the numbers that decide.

    First the answer and how far apart the cameras are, then the distance beside what chance
    explains, then the largest likely error beside what each use allows. whose: the sigma is.
    """
    return (_answer_text(found), _distance_text(found, whose), _limits_text(found))


def _answer_text(found: Difference) -> str:
    if found.apart is None:
        return 'not comparable: one lens model has no ray for a part of the picture'
    far = (f'{found.apart.rms:.2f} px RMS over the picture, {found.apart.worst:.2f} px at the '
           f'worst, best rotation removed')
    enough = f'good enough for {", ".join(found.good_for)}'
    if found.answer == 'right':
        return f'the same within what can be determined; {far}: {enough}'
    if found.answer == 'differs':
        return f'differs by {far}: {enough}'
    if found.answer == 'cannot tell':
        what = 'differs by' if found.told_apart else 'chance explains the difference of'
        return f'{what} {far}; but its error may be too large for every use'
    parts = ' and '.join(_blamed(found))
    return f'off by {far}{parts and f", because of the {parts}"}'


def _distance_text(found: Difference, whose: str) -> str:
    if found.distance is None or found.sigma_px is None:
        return ('statistic: unknown, because neither file has a covariance; use a result.json of '
                'dashcalib run')
    explained = 'does not explain' if found.told_apart else 'explains'
    return (f'statistic: distance {found.distance:.1f} sigma (Mahalanobis), limit '
            f'{found.limit:.1f}: chance {explained} the difference; the standard deviation '
            f'(sigma) of {whose} is {found.sigma_px.rms:.2f} px')


def _limits_text(found: Difference) -> str:
    if found.rms_px is None:
        return 'limits: no pixels to compare them with'
    limits = ', '.join(f'{use} {_px(limit)} ({_px(SURE * limit)})'
                       for use, limit in found.limits_px.items())
    first = (f'{_px(found.rms_px)} px' if found.sigma_px is None else
             f'{_px(found.rms_px)} px, with 95 % confidence below {_px(found.bound_px)} px')
    centre = '' if not found.centre_off else (
        f'; the centre is off by more than {CENTRE * found.given.image_size[0]:.0f} px')
    return f'limits in px (with 95 % confidence): {limits}; here {first}{centre}'


def _px(value: float) -> str:
    """Return pixels with two digits, so that a value and its limit can be compared."""
    return f'{value:.2f}'


def _blamed(found: Difference) -> Sequence[Way]:
    if found.covariance is None or distance(found.offsets, found.covariance) <= found.limit:
        return ()
    return tuple(found.ways())


def reasons_of(found: Difference) -> tuple[str, ...]:
    """Return in words what the difference from a drive's own camera says."""
    parts = ([_PARTS[way](found, *off) for way, off in found.ways().items()]
             if _blamed(found) else [])
    return (*answers_of(found, 'the drive'), *(text for text in parts if text))


def _focal(found: Difference, offsets: Floats, sigmas: Floats) -> str:
    shares, sure = (100 * each / [found.found.fx, found.found.fy] for each in (offsets, sigmas))
    if max(abs(shares)) == 0:
        return ''

    def text(share: float, sigma: float) -> str:
        return f'{abs(share):.1f} ± {sigma:.1f} % too {"long" if share > 0 else "short"}'

    if abs(shares[0] - shares[1]) < 0.5 * max(abs(shares)):
        return f'focal length: {text(shares.mean(), sure.max())}'
    names = [f'{name} {text(share, sigma)}'
             for name, share, sigma in zip(('fx', 'fy'), shares, sure, strict=True)
             if abs(share) > 0.25 * max(abs(shares))]
    return f'focal length: {", ".join(names)}'


def _centre(found: Difference, offsets: Floats, sigmas: Floats) -> str:
    sides = [f'{abs(value):.1f} ± {sigma:.1f} px too far {way[int(value > 0)]}'
             for value, sigma, way in zip(offsets, sigmas, (('left', 'right'), ('up', 'down')),
                                          strict=True)
             if abs(value) > 0.25 * max(abs(offsets))]
    text = f'centre: {" and ".join(sides)}'
    if max(abs(offsets)) > CROPPED * found.given.image_size[0]:
        text += ': is the calibration for another part of the picture?'
    return text


def _distortion(found: Difference, offsets: Floats, sigmas: Floats) -> str:
    off = list(zip(found.found.names()[4:], offsets, sigmas, strict=True))
    # some compensate each other: what is known about them together may be known about none alone
    shown = [each for each in off if abs(each[1]) > 2 * each[2]] or off
    values = []
    for name, value, sigma in shown:
        digits = int(np.clip(1 - np.floor(np.log10(sigma)), 3, 6)) if sigma > 0 else 3
        values.append(f'{name} {value:+.{digits}f} ± {sigma:.{digits}f}')
    return f'distortion: off by {", ".join(values)}'


_PARTS = {'focal length': _focal, 'centre': _centre, 'distortion': _distortion}


# combined sigmas; a larger difference is a contradiction
CONTRADICTION = 3.0
# of fx; least sigma: good calibrations of one lens differ by this much, also with smaller sigmas
LEAST_SIGMA = 0.0025
# in every model fx and fy are the scale on the axis, so that two models of one lens agree in them;
# the coefficients of distortion are not compared: they are correlated with the focal length
COMPARED = ('fx', 'fy', 'cx', 'cy')


def contradicted(old: Camera, old_sigma: Mapping[str, float] | None, new: Camera,
                 new_sigma: Mapping[str, float]) -> list[str]:
    """Return texts for the parameters in which the two contradict each other."""
    found = []
    floor = LEAST_SIGMA * old.fx
    for name in COMPARED:
        before, after = getattr(old, name), getattr(new, name)
        own = old_sigma[name] if old_sigma is not None else 0.0
        spread = math.hypot(max(own, floor), max(new_sigma[name], floor))
        if abs(after - before) > CONTRADICTION * spread:
            found.append(f'{name} {after:.1f} instead of {before:.1f} px')
    return found
