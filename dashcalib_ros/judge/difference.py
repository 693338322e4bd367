"""How far two calibrations are apart, whether that can be told, and whether it matters.

One answer for `check`, where a given camera meets a drive's own, and for `compare`, where two
files meet. The camera that was found is a normal distribution of its n parameters. The other is a
point among them, at a Mahalanobis distance that chance explains or not. Good calibrations of one
lens differ by a little in any case: only what goes beyond that matters. Which parameters make it
far is asked by leaving them out: what the rest alone is away from its own distribution.
"""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as default
from functools import cached_property
from typing import Literal

import numpy as np

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.field import Field
from dashcalib_ros.camera.mapping import Apart, apart, as_model, sensitivity
from dashcalib_ros.errors import InputError
from dashcalib_ros.judge.calibration import Mount
from dashcalib_ros.solve.solution import Solution
from dashcalib_ros.solve.spread import PictureSigma, SigmaMap, sigma_over

Way = Literal['focal length', 'centre', 'distortion']
# the first parameters of every camera; all behind them are of the distortion
PLACES: dict[Way, tuple[int, ...]] = {'focal length': (0, 1), 'centre': (2, 3)}
# by how much good calibrations of one lens differ: of fx and fy (two that KITTI ships: 0.44 %),
# and px of cx and cy (pixels begin half a pixel elsewhere in some programs)
ALLOWED_FOCAL = 0.005
ALLOWED_CENTRE_PX = 1.0
# of the focal length; a drive that calls a camera right must be able to see what this one makes
RELEVANT = 0.02
# how often chance alone exceeds the limit of a distance, and where it begins to be doubtful
CHANCE = 1e-3
DOUBT = 0.05


@dataclass(frozen=True)
class Difference:
    """A given camera beside one that was found, in px of the same pictures.

    offsets: (n,) given minus found, in the parameters of a model that has both; covariance: (n, n)
    of them; None where neither is known. apart: how far both see a ray; None where they cannot be
    compared. sigma_px: of what is known of both, over the picture.
    """

    given: Camera
    found: Camera
    offsets: Floats
    covariance: Floats | None
    apart: Apart | None
    sigma_px: PictureSigma | None

    @property
    def limit(self) -> float:
        """Return the distance that chance alone exceeds once in a thousand drives."""
        return limit_of(len(self.offsets))

    @cached_property
    def distance(self) -> float | None:
        """Return by how many sigmas they differ more than good calibrations of one lens do."""
        return None if self.covariance is None else distance(self.offsets, self.covariance,
                                                             self._allowed)

    @property
    def significant(self) -> bool:
        """Return whether they differ more than chance and good calibrations do."""
        if self.distance is None or self.sigma_px is None:
            return self.rms_px is None or self.rms_px > self.allowed_px
        return not self.distance <= self.limit or (
            self.rms_px is not None and self.rms_px - 2 * self.sigma_px.rms > self.relevant_px)

    @property
    def told_apart(self) -> bool | None:
        """Return whether more than chance is between them; None where no sigma is known."""
        if self.covariance is None or self.sigma_px is None:
            return None
        return not distance(self.offsets, self.covariance) <= self.limit or (
            self.rms_px is None or self.rms_px > self.limit * self.sigma_px.rms)

    @property
    def matters(self) -> bool | None:
        """Return whether the difference is one that good calibrations do not have.

        False: it is below what a focal length RELEVANT off makes, with 95 %. None: neither.
        """
        if self.significant:
            return True
        if self.distance is None:
            return False
        doubtful = self.distance > limit_of(len(self.offsets), DOUBT)
        return False if self.bound_px <= self.relevant_px and not doubtful else None

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

    @property
    def allowed_px(self) -> float:
        """Return what the focal length moves, over the picture, where good calibrations differ."""
        return ALLOWED_FOCAL / RELEVANT * self.relevant_px

    @cached_property
    def relevant_px(self) -> float:
        """Return what a focal length RELEVANT off moves, over the picture."""
        moves, _ = sensitivity(self.found)
        longer = RELEVANT * self.found.params * (np.arange(len(self.found.params)) < 2)
        return float(np.sqrt(np.mean(np.sum((moves @ longer)**2, axis=1))))

    @property
    def sigma_map(self) -> SigmaMap | None:
        """Return the sigma of the difference at the pixels of a grid over the picture."""
        if self.covariance is None:
            return None
        model = self.found if len(self.found.params) == len(self.offsets) else self.given
        moves, pixels = sensitivity(model)
        return SigmaMap(pixels, sigma_over(moves, self.covariance))

    @property
    def _allowed(self) -> Floats:
        allowed = np.zeros(len(self.offsets))
        allowed[:2] = ALLOWED_FOCAL * self.found.params[:2]
        allowed[2:4] = ALLOWED_CENTRE_PX
        return allowed

    def ways(self) -> Mapping[Way, Floats]:
        """Return the fewest parts of the camera that explain the distance, the largest first.

        Each with its offsets that are left when the other parts are as the drive says.
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
        expected = self.covariance[np.ix_(places, rest)] @ np.linalg.solve(
            self.covariance[np.ix_(rest, rest)], self.offsets[rest])
        own = dict(zip(places.tolist(), self.offsets[places] - expected, strict=True))
        return {way: np.array([own[place] for place in self._places([way])]) for way in chosen}

    def _without(self, ways: Sequence[Way]) -> float:
        assert self.covariance is not None
        rest = np.setdiff1d(np.arange(len(self.offsets)), self._places(ways))
        return distance(self.offsets[rest], self.covariance[np.ix_(rest, rest)],
                        self._allowed[rest])

    def _places(self, ways: Sequence[Way]) -> list[int]:
        count = len(self.offsets)
        return [place for way in ways for place in PLACES.get(way, range(4, count))]


def limit_of(count: int, chance: float = CHANCE) -> float:
    """Return the Mahalanobis distance of so many parameters that chance exceeds so often."""
    from scipy import special
    return float(np.sqrt(special.chdtri(count, chance))) if count else 0.0


def distance(offsets: Floats, covariance: Floats, allowed: Floats | None = None) -> float:
    """Return the Mahalanobis distance of offsets (n,); 0 for none.

    allowed: (n,) by how much each may be nearer to 0; the nearest point counts.
    """
    from scipy.optimize import lsq_linear
    if not len(offsets):
        return 0.0
    root = np.linalg.cholesky(covariance)
    free = np.zeros(0, int) if allowed is None else np.flatnonzero(allowed)
    away = np.linalg.solve(root, offsets)
    if allowed is None or not len(free):
        return float(np.linalg.norm(away))
    slack = np.linalg.solve(root, np.diag(allowed)[:, free])
    return float(np.sqrt(2 * lsq_linear(slack, away, (-1.0, 1.0), method='bvls').cost))


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
    own = found.resized(px, given.image_size)
    return Difference(
        given, own, offsets * units,
        solution.covariance * np.outer(units, units), apart(given, own),
        solution.picture.times(px))


@dataclass(frozen=True)
class NamedCamera:
    """A camera as a file or a truth has it, with its name, sigma and verdict.

    name: where it is from, for messages. sigma: by the parameters' names; None unless all are
    known. verdict: accepted or weak; None where the file has none (a truth, another tool's file).
    covariance: (n, n) of the parameters, as the picture shows them, and sigma_px: over the
    picture; None where the file does not say.
    field: what its lens model leaves over, where a result.json has one that is used. mount: how it
    sits on the car, where the file says. readout_ms: of a rolling shutter, from the first row to
    the last; None where the file has none.
    faults: in words, of what else stands beside the camera (ROS's K, R and P).
    """

    name: str
    camera: Camera
    sigma: Mapping[str, float] | None = None
    verdict: str | None = None
    covariance: Floats | None = default(default=None, compare=False)
    sigma_px: PictureSigma | None = None
    field: Field | None = default(default=None, compare=False)
    mount: Mount | None = default(default=None, compare=False)
    readout_ms: float | None = default(default=None, compare=False)
    faults: tuple[str, ...] = ()

    def without_faults(self) -> NamedCamera:
        """Return it; raises InputError where something beside the camera is wrong."""
        if self.faults:
            raise InputError(f'{self.name}: {"; ".join(self.faults)}; no model here has that')
        return self

    @property
    def image_size(self) -> tuple[int, int]:
        """Return (width, height) in pixels."""
        return self.camera.image_size


def difference_between(given: NamedCamera, found: NamedCamera) -> Difference:
    """Compare two cameras of which there is no more than what their files say."""
    # in the parameters of one whose covariance is known, so that theirs together has full rank
    base = found if found.covariance is not None else given
    a, b = (each.camera if type(each.camera) is type(base.camera)
            else as_model(each.camera, type(base.camera)) for each in (given, found))
    covariances = [_carried(each.covariance, each.camera, base.camera)
                   for each in (given, found) if each.covariance is not None]
    sigmas = [each.sigma_px for each in (given, found) if each.sigma_px is not None]
    return Difference(
        given.camera, found.camera, a.params - b.params,
        np.sum(covariances, axis=0) if covariances else None,
        apart(given.camera, found.camera),
        PictureSigma(float(np.hypot.reduce([each.rms for each in sigmas])),
                     float(np.hypot.reduce([each.worst for each in sigmas]))) if sigmas else None)


def _carried(covariance: Floats, camera: Camera, to: Camera) -> Floats:
    """Return what a camera's covariance is in the parameters of another model."""
    if type(camera) is type(to):
        return covariance
    (moves, pixels), (others, also) = sensitivity(camera), sensitivity(to)
    mine, theirs = np.nonzero((pixels[:, None] == also).all(axis=2))
    carry, *_ = np.linalg.lstsq(others[theirs].reshape(-1, others.shape[2]),
                                moves[mine].reshape(-1, moves.shape[2]), rcond=None)
    return np.asarray(carry @ covariance @ carry.T)


# of the width; a centre that is farther off looks like that of a part of the picture
CROPPED = 0.04


def answers_of(found: Difference, whose: str) -> tuple[str, ...]:
    """Return what a difference says: how far, whether it can be told, whether it matters.

    whose: the sigma is.
    """
    far = ('apart: unknown, a lens model is blind in parts of the picture' if found.apart is None
           else f'apart: {found.apart.rms:.2f} px over the picture, {found.apart.worst:.2f} px at '
                f'the worst, best rotation removed')
    sigma = None if found.sigma_px is None else found.sigma_px.rms
    told = ('unknown, neither file has a covariance: give a result.json of dashcalib run'
            if sigma is None or found.told_apart is None else
            f'{"yes" if found.told_apart else "no, chance explains it"}; the sigma of {whose} is '
            f'{sigma:.2f} px')
    return (far, f'told apart: {told}', f'matters: {_matters(found)}')


def _matters(found: Difference) -> str:
    limit = f'{found.relevant_px:.1f} px, as of a focal length {100 * RELEVANT:.0f} % off'
    if found.matters:
        return (f'yes, good calibrations of one lens differ by less: '
                f'{100 * ALLOWED_FOCAL:.1f} % of the focal length ({found.allowed_px:.1f} px over '
                f'the picture), {ALLOWED_CENTRE_PX:.0f} px of the centre')
    if found.sigma_px is None:
        return (f'no, good calibrations of one lens differ by up to {found.allowed_px:.1f} px, as '
                f'of a focal length {100 * ALLOWED_FOCAL:.1f} % off')
    if found.matters is None and found.bound_px <= found.relevant_px:
        return ('cannot be told: good calibrations of one lens hardly differ as much, but chance '
                'may explain the rest')
    if found.matters is None:
        return f'cannot be told: an error of {limit}, may be there'
    return f'no, with 95 % it is below {found.bound_px:.1f} px; the limit is {limit}'


def reasons_of(found: Difference) -> tuple[str, ...]:
    """Return in words what the difference from a drive's own camera says."""
    parts = ([_PARTS[way](found, offsets) for way, offsets in found.ways().items()]
             if found.matters else [])
    return (*answers_of(found, 'the drive'), *(text for text in parts if text))


def _focal(found: Difference, offsets: Floats) -> str:
    shares = offsets / [found.found.fx, found.found.fy]
    if max(abs(shares)) == 0:
        return ''
    if abs(shares[0] - shares[1]) < 0.5 * max(abs(shares)):
        share = float(shares.mean())
        return (f'focal length: {100 * abs(share):.1f} % too {"long" if share > 0 else "short"}')
    names = [f'{name} {100 * abs(share):.1f} % too {"long" if share > 0 else "short"}'
             for name, share in zip(('fx', 'fy'), shares, strict=True)
             if abs(share) > 0.25 * max(abs(shares))]
    return f'focal length: {", ".join(names)}'


def _centre(found: Difference, offsets: Floats) -> str:
    x, y = offsets
    sides = [f'{abs(value):.1f} px too far {way[int(value > 0)]}'
             for value, way in ((x, ('left', 'right')), (y, ('up', 'down')))
             if abs(value) > 0.25 * max(abs(x), abs(y))]
    text = f'centre: {" and ".join(sides)}'
    if max(abs(x), abs(y)) > CROPPED * found.given.image_size[0]:
        text += ': is the calibration for another part of the picture?'
    return text


def _distortion(found: Difference, offsets: Floats) -> str:
    names = found.found.names()[4:]
    values = [f'{name} {value:+.3f}' for name, value in zip(names, offsets, strict=True)]
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
