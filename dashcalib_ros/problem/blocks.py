# SPDX-License-Identifier: Apache-2.0
"""The unknowns of the one problem, one class for each kind; BLOCKS has them all.

A pixel (u, v) is observed where

    ideal(u, v) = lens(pose at the time of row v, point)

and ideal() takes out what the blocks of the picture do to it: each image's shift and zoom, then
the field. A block has its present value, its columns in the linearised problem, a prior, and how
it moves. A new kind of unknown is one more class, and a row in BLOCKS.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, Literal, TypeVar

import numpy as np

from dashcalib_ros.arrays import Floats, Ints
from dashcalib_ros.camera import Camera
from dashcalib_ros.camera.field import TERMS, Field, field_terms
from dashcalib_ros.camera.mapping import sensitivity, turned
from dashcalib_ros.camera.rotation import crossed
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.input.motion import Samples
from dashcalib_ros.problem.observations import Observed, Stretch, main_axis
from dashcalib_ros.problem.quadratic import Quadratic

# what a block's value is for: the camera, each stretch of it, or each of its images
Scope = Literal['camera', 'stretch', 'image']

# px; a residual of a point that is behind the camera
BEHIND_PX = 1e3
# s; with a shorter readout, how the poses change the camera's motion does not count
COUPLED_READOUT_S = 1e-3


@dataclass(frozen=True)
class Seen:
    """Where the n observed points of a stretch are in the camera's axes, and projected.

    rotated: (n, 3) the world's points, rotated. still: (n, 3) at the time of the middle row;
    local: (n, 3) at the time of their rows. turning: (n, 3) rad of the camera, from the first row
    to the last. by_readout: (n, 3) how far they move for a second of readout. late: (n,) when
    their rows are exposed, in readouts after the middle one. projected: (n, 2) px; off: (n, 2)
    observed minus projected, both where the lens alone would see them; BEHIND_PX where it does
    not see a point.
    """

    stretch: Stretch
    observed: Observed
    imaging: Imaging
    rotated: Floats
    still: Floats
    local: Floats
    turning: Floats
    by_readout: Floats
    late: Floats

    @cached_property
    def projected(self) -> Floats:
        """Return (n, 2) where the points are projected; NaN behind the camera."""
        with np.errstate(divide='ignore', invalid='ignore'):
            return self.imaging.camera.project(self.local)

    @cached_property
    def off(self) -> Floats:
        """Return (n, 2) observed minus projected, px."""
        return np.nan_to_num(self.imaging.ideal_of(self.observed) - self.projected, nan=BEHIND_PX)

    @cached_property
    def derivatives(self) -> tuple[Floats, Floats, Floats]:
        """Return the camera's: (n, 2, p) by parameters, (n, 2, 3) by points, and projected."""
        with np.errstate(divide='ignore', invalid='ignore'):
            return self.imaging.camera.derivatives(self.local)

    @property
    def from_middle(self) -> Floats:
        """Return (n, 2) px of where the points are projected from the picture's middle."""
        return np.asarray(self.projected - middle(self.imaging.camera.image_size))


Self = TypeVar('Self', bound='Block')


@dataclass(frozen=True)
class Block:
    """A kind of unknown: its value, and what the problem must know about it.

    held: it does not move, and costs nothing.
    """

    held: bool = field(default=False, kw_only=True)

    name: ClassVar[str]
    scope: ClassVar[Scope] = 'camera'

    @property
    def size(self) -> int:
        """Return how many parameters are free, of each image where they have their own."""
        raise NotImplementedError

    def columns(self, seen: Seen) -> Floats:
        """Return (2, c, n) derivatives of where points are observed."""
        raise NotImplementedError

    def ideal(self, xy: Floats, observed: Observed) -> Floats:
        """Return (n, 2) pixels without what this block does to the picture."""
        return xy

    def anchored(self: Self, imaging: Imaging) -> Self:
        """Return the block with what its prior takes from others at their present values."""
        return self


@dataclass(frozen=True)
class SharedBlock(Block):
    """A block with one value for all stretches of a camera. value: (c,)."""

    value: Floats

    def prior(self) -> tuple[Floats, Floats]:
        """Return the information (c, c) of the prior, and (c,) how far the value is off it."""
        raise NotImplementedError

    @property
    def log_density(self) -> float:
        """Return the log of the prior's density at the present value, up to a constant."""
        information, off = self.prior()
        return 0.5 * float(np.linalg.slogdet(information)[1] - off @ information @ off)

    def moved(self, step: Floats) -> SharedBlock:
        """Return the block after a step (c,)."""
        return replace(self, value=self.value + step)

    def clipped(self, step: Floats) -> Floats:
        """Return a step (c,) as far as bounds allow it."""
        return step

    @property
    def size(self) -> int:
        return len(self.value)

    @property
    def names(self) -> list[str]:
        """Return the names of the c parameters, for people."""
        return [self.name] if self.size == 1 else [f'{self.name} {n}' for n in range(self.size)]


@dataclass(frozen=True)
class ImageBlock(Block):
    """A block with a value for each image: by stretch (k, c); none where it is not in it."""

    value: Mapping[TurnId, Floats] = field(default_factory=dict)

    scope: ClassVar[Scope] = 'image'
    count: ClassVar[int] = 1
    # its columns are those of how the camera turns while its rows are exposed
    turns: ClassVar[bool] = False

    @property
    def size(self) -> int:
        return self.count

    def within(self, stretch: Stretch) -> bool:
        """Return whether a stretch has these values."""
        return True

    def of(self, stretch: Stretch) -> Floats:
        """Return (k, c) the values of a stretch's keyframes."""
        still = np.zeros((len(stretch.tracks.frames), self.count))
        return self.value.get(stretch.turn, still)

    def prior_of(self, stretch: Stretch) -> tuple[Floats, Floats]:
        """Return the information (k c, k c) for the k used keyframes, and (k c,) the values."""
        raise NotImplementedError

    def moved_in(self, stretch: Stretch, step: Floats) -> ImageBlock:
        """Return the block after a step (k c,) of the used keyframes of a stretch."""
        value = self.of(stretch).copy()
        value[stretch.observed.keyframes] += step.reshape(-1, self.count)
        return replace(self, value={**self.value, stretch.turn: value})


# the lens

# of the width: how far lenses sit off the middle of their sensors
CENTRE_SIGMA = 0.02
# how far parameters may go from the centred camera: fx and fy of its focal length; the centre of
# the picture's width and height, as a third may be cut off on one side; no lens has larger k1, k2
FOCAL_BOUND, CENTRE_BOUND, DISTORTION_BOUND = 0.15, (0.2, 0.3), 1.0
# of fy / fx, where pixels are not square, and the nats of evidence that this takes
NOT_SQUARE, NOT_SQUARE_NATS = 0.05, 3.0


@dataclass(frozen=True)
class Lens(SharedBlock):
    """The camera, with n parameters.

    directions: (n, q) of a step; None: all. bounds: (2, n) lowest and highest values. centred:
    the camera that the prior is about; None: there is none. aspect_sigma: of fy / fx.
    """

    value: Floats = field(init=False)
    camera: Camera
    directions: Floats | None = None
    bounds: Floats | None = None
    centred: Camera | None = None
    aspect_sigma: float = 0.0

    name: ClassVar[str] = 'lens'

    def __post_init__(self) -> None:
        object.__setattr__(self, 'value', self.camera.params)

    @property
    def size(self) -> int:
        return len(self.value) if self.directions is None else self.directions.shape[1]

    def columns(self, seen: Seen) -> Floats:
        found = seen.derivatives[0].transpose(1, 2, 0)
        return found if self.directions is None else np.asarray(self.directions.T @ found)

    def prior(self) -> tuple[Floats, Floats]:
        if self.centred is None:
            return np.zeros((self.size, self.size)), np.zeros(self.size)
        mean, covariance = prior_of(self.centred, self.aspect_sigma)
        information, off = np.asarray(np.linalg.inv(covariance)), self.value - mean
        if self.directions is None:
            return information, off
        inner = self.directions.T @ information @ self.directions
        return inner, np.asarray(np.linalg.solve(inner, self.directions.T @ information @ off))

    def moved(self, step: Floats) -> Lens:
        return replace(self, camera=self.camera.with_params(self._after(step)))

    def _after(self, step: Floats) -> Floats:
        params = self.value + (step if self.directions is None else self.directions @ step)
        return params if self.bounds is None else np.clip(params, *self.bounds)

    def clipped(self, step: Floats) -> Floats:
        step = self._after(step) - self.value
        if self.directions is None:
            return step
        return np.asarray(self.directions.T @ step / np.sum(self.directions**2, axis=0))

    @property
    def names(self) -> list[str]:
        names = list(self.camera.names())
        return names if self.directions is None else [
            names[int(np.argmax(np.abs(column)))] for column in self.directions.T]


def prior_of(camera: Camera, aspect_sigma: float) -> tuple[Floats, Floats]:
    """Return mean (n,) and covariance (n, n): square pixels and a centred principal point.

    camera: centred, as found with one focal length. aspect_sigma: of fy / fx.
    """
    width, _ = camera.image_size
    wide = (10 * camera.fx) ** 2
    spread = np.diag([wide, wide, (CENTRE_SIGMA * width) ** 2,
                      (CENTRE_SIGMA * width) ** 2, *np.square(camera.spread)])
    # fx is free; fy equals fx to within the sigma of the aspect ratio
    spread[0, 1] = spread[1, 0] = wide
    spread[1, 1] += (aspect_sigma * camera.fx) ** 2
    return _undistorted(camera), spread


def bounds_of(camera: Camera, focal_reach: float = FOCAL_BOUND) -> Floats:
    """Return (2, n) the lowest and the highest values that are allowed, about a centred camera."""
    width, height = camera.image_size
    reach = np.full(len(camera.names()), DISTORTION_BOUND)
    reach[:4] = (camera.fx * focal_reach, camera.fx * focal_reach,
                 width * CENTRE_BOUND[0], height * CENTRE_BOUND[1])
    return np.array([_undistorted(camera) - reach, _undistorted(camera) + reach])


def _undistorted(camera: Camera) -> Floats:
    return type(camera).centred(camera.image_size, camera.fx).params


# the shutter: a point is seen from where the camera is at the time of its row

# s: most dashcams have a rolling shutter, of 10 to 30 ms
READOUT_SIGMA_S = 0.02
# prior sigmas of how fast a camera turns: about the axis of the turn, beyond what the spline says,
# and about the others in all on a smooth road (3 degrees a second)
STEERING_RAD_S, BUMPS_RAD_S = 0.005, 0.05
# degrees: bumps turn a camera by less
STEERED_DEG = 15.0


@dataclass(frozen=True)
class Readout(SharedBlock):
    """How long the shutter reads from the first row to the last, (1,) s."""

    value: Floats = field(default_factory=lambda: np.zeros(1))

    name: ClassVar[str] = 'readout'

    def columns(self, seen: Seen) -> Floats:
        by_local = seen.derivatives[1]
        return np.asarray((by_local @ seen.by_readout[:, :, None]).transpose(1, 2, 0))

    def prior(self) -> tuple[Floats, Floats]:
        return np.full((1, 1), READOUT_SIGMA_S**-2), self.value


@dataclass(frozen=True)
class Shake(ImageBlock):
    """By how much each camera turns, rad from the first row to the last, beyond its steering.

    As bumps make it; Imaging.steering has the rest. axes: by stretch (3,) about which the car
    turns, in the camera's axes. readout_s, bumps: s and rad, at which the prior is taken; a step
    does not change them, or a longer readout would make the same shaking likelier. bumps is how
    far the images shake (RMS): with the prior of a smooth road a rough one shifts fx and readout.
    """

    axes: Mapping[TurnId, Floats] = field(default_factory=dict)
    readout_s: float = 0.0
    bumps: float = 0.0

    name: ClassVar[str] = 'shake'
    count: ClassVar[int] = 3
    turns: ClassVar[bool] = True

    def prior_of(self, stretch: Stretch) -> tuple[Floats, Floats]:
        used = stretch.observed.keyframes
        axis, time_s = self.axes[stretch.turn], max(abs(self.readout_s), COUPLED_READOUT_S)
        # bumps pitch and roll the car; about the axis of the turn it is the driver who turns it
        bumps, steering = max(self.bumps, BUMPS_RAD_S * time_s), STEERING_RAD_S * time_s
        each = np.eye(3) / bumps**2 + np.outer(axis, axis) * (steering**-2 - bumps**-2)
        return np.asarray(np.kron(np.eye(len(used)), each)), self.of(stretch)[used].ravel()

    def anchored(self, imaging: Imaging) -> Shake:
        if not imaging.coupled:
            return replace(self, readout_s=imaging.readout_s, bumps=0.0, value={})
        shaken = np.concatenate([np.zeros((0, 3)), *(
            turned @ (np.eye(3) - np.outer(self.axes[turn], self.axes[turn]))
            for turn, turned in self.value.items())])
        # about two axes, of the keyframes that have a pose
        count = 2 * max(int(shaken.any(axis=1).sum()), 1)
        return replace(self, readout_s=imaging.readout_s,
                       bumps=float(np.sqrt(np.sum(shaken**2) / count)))


# the residual distortion over the picture

# singular values below this share of the largest: the camera cannot make such a field
LEAST_PART = 1e-3


@dataclass(frozen=True)
class Smooth(SharedBlock):
    """The smooth residual distortion. value: (f,) px, how far it goes in each direction.

    basis: (2 len(TERMS), f) the directions, see field_basis(). sigma: of the prior of each, px.
    """

    value: Floats = field(default_factory=lambda: np.zeros(0))
    basis: Floats = field(default_factory=lambda: np.zeros((2 * len(TERMS), 0)))
    sigma: float = 0.1

    name: ClassVar[str] = 'field'

    def columns(self, seen: Seen) -> Floats:
        # where points are projected; the errors of observations would correlate with the terms
        terms, count = field_terms(seen.projected, seen.imaging.camera.image_size).T, len(TERMS)
        return np.stack([self.basis[:count].T @ terms, self.basis[count:].T @ terms])

    def ideal(self, xy: Floats, observed: Observed) -> Floats:
        if not self.value.any():
            return xy
        terms = (observed.terms if xy is observed.xy else field_terms(xy, observed.image_size))
        return np.asarray(xy - terms @ (self.basis @ self.value).reshape(2, -1).T)

    def prior(self) -> tuple[Floats, Floats]:
        return np.eye(len(self.value)) * self.sigma**-2, self.value


def displacements(pixels: Floats, image_size: tuple[int, int], basis: Floats) -> Floats:
    """Return (..., 2, f) the fields of f directions (2 len(TERMS), f) at pixels (..., 2)."""
    terms, count = field_terms(pixels, image_size), len(TERMS)
    return np.stack([terms @ basis[:count], terms @ basis[count:]], axis=-2)


def field_basis(camera: Camera) -> Floats:
    """Return (2 len(TERMS), f) directions that no change of the camera and no rotation makes.

    They are scaled so that the prior of a field of size 1 is the unit matrix: smaller for higher
    degrees.
    """
    moves, pixels = sensitivity(camera)
    fields = displacements(pixels, camera.image_size, np.eye(2 * len(TERMS)))
    # rotations of the camera move all pixels, and sensitivity() leaves them out
    rays = camera.rays(pixels)
    by_rotation = camera.derivatives(rays)[1] @ turned(rays)
    by_camera = np.concatenate([moves, by_rotation], axis=2).reshape(-1, moves.shape[2] + 3)
    made, _ = np.linalg.qr(by_camera / np.linalg.norm(by_camera, axis=0))
    _, parts, rows = np.linalg.svd(made.T @ fields.reshape(len(made), -1))
    free = rows[int((parts > LEAST_PART * parts[0]).sum()):].T
    degree = np.maximum(np.array(TERMS).sum(axis=1) - 1, 1)
    precision = free.T * np.tile(degree.astype(np.float64)**2, 2) @ free
    return np.asarray(free @ np.linalg.inv(np.linalg.cholesky(precision)).T)


def lens_like(camera: Camera) -> Floats:
    """Return (n, n) the covariance of the camera's parameters by a smooth error of the pictures.

    Of a field of size 1: what of it the parameters would take up.
    """
    moves, pixels = sensitivity(camera)
    degree = np.array(TERMS).sum(axis=1)
    scale = np.where(degree > 1, 1 / np.maximum(degree - 1, 1), 0.0)
    fields = displacements(pixels, camera.image_size, np.diag(np.tile(scale, 2)))
    made, *_ = np.linalg.lstsq(moves.reshape(-1, moves.shape[2]),
                               fields.reshape(-1, fields.shape[2]))
    return np.asarray(made @ made.T)


# columns and rows over the picture of places at which a local bend is estimated
BENDS = (5, 4)
# prior sigma of the bend at each of them, px
BEND_PX = 3.0


@dataclass(frozen=True)
class Bend(SharedBlock):
    """Displacements at places over the picture, px: those in x, then those in y.

    They are only estimated, never removed from a picture.
    """

    value: Floats = field(default_factory=lambda: np.zeros(2 * BENDS[0] * BENDS[1]))

    name: ClassVar[str] = 'bend'

    def columns(self, seen: Seen) -> Floats:
        places = (seen.projected / np.array(seen.imaging.camera.image_size)).T
        x, y = ((np.arange(count) + 0.5) / count for count in BENDS)
        across = np.exp(-0.5 * ((places[0] - x[:, None]) * BENDS[0])**2)
        down = np.exp(-0.5 * ((places[1] - y[:, None]) * BENDS[1])**2)
        # the weights of the places at a pixel sum to 1
        weight = (across[:, None] * down).reshape(-1, places.shape[1])
        weight /= np.maximum(weight.sum(axis=0), 1e-9)
        zero = np.zeros_like(weight)
        return np.stack([np.concatenate([weight, zero]), np.concatenate([zero, weight])])

    def prior(self) -> tuple[Floats, Floats]:
        return np.eye(len(self.value)) * BEND_PX**-2, self.value


# what changes with time

# s before the first sample of a temperature and after the last one for which they stand
BESIDE_S = 60.0


@dataclass(frozen=True)
class Warmth:
    """The temperature during a drive, degrees Celsius. samples: (n, 1), on the images' clock.

    mean_c: of its turns; coldest_c, warmest_c: in them.
    """

    samples: Samples
    mean_c: float
    coldest_c: float
    warmest_c: float

    @classmethod
    def over(cls, samples: Samples | None, turns_ns: Sequence[Ints]) -> Warmth | None:
        """Return that of turns, by the stamps (k,) of each; None where one of them is unknown."""
        if samples is None or not turns_ns:
            return None
        stamps_s = np.concatenate(turns_ns) / 1e9
        first, last = samples.stamps_s[0] - BESIDE_S, samples.stamps_s[-1] + BESIDE_S
        if stamps_s.min() < first or stamps_s.max() > last:
            return None
        then = [samples.at(own / 1e9) for own in turns_ns]
        every = np.concatenate(then)
        return cls(samples, float(np.mean([own.mean() for own in then])), float(every.min()),
                   float(every.max()))

    @property
    def span_k(self) -> float:
        """Return by how many kelvins it changes."""
        return self.warmest_c - self.coldest_c


@dataclass(frozen=True)
class Drift(SharedBlock):
    """By how much the picture grows during the drive, of 1; (c,), one for each way of growing.

    With the time from its begin to its end, as of a lens that warms up, where steady; with the
    temperature from its coldest turn to its warmest, where there is warmth; and at each of
    steps_ns, as where somebody touches the lens. begin_ns, end_ns: of the drive. sigma: of the
    prior. Earlier drives have their own temperature, and none of it.
    """

    value: Floats = field(default_factory=lambda: np.zeros(1))
    begin_ns: int = 0
    end_ns: int = 1
    sigma: float = 0.01
    steady: bool = True
    warmth: Warmth | None = None
    steps_ns: tuple[int, ...] = ()

    name: ClassVar[str] = 'drift'

    def columns(self, seen: Seen) -> Floats:
        return np.asarray(seen.from_middle.T[:, None] * self.grown(seen.observed).T)

    def ideal(self, xy: Floats, observed: Observed) -> Floats:
        centre = middle(observed.image_size)
        return np.asarray(centre + (xy - centre) / (
            1 + self.grown(observed) @ self.value)[:, None])

    def prior(self) -> tuple[Floats, Floats]:
        return np.eye(len(self.value)) * self.sigma**-2, self.value

    def grown(self, observed: Observed) -> Floats:
        """Return (n, c) how far each way is at each observation, of 1, from its middle."""
        if not observed.turn.of_this_drive:
            return np.zeros((len(observed.xy), len(self.value)))
        return self.grown_at(observed.stamps_ns)

    def grown_at(self, stamps_ns: Ints) -> Floats:
        """Return (n, c) the same at stamps (n,)."""
        ways = [(stamps_ns >= step_ns) - 0.5 for step_ns in self.steps_ns]
        if self.warmth is not None:
            warm = self.warmth.samples.at(stamps_ns / 1e9)[:, 0] - self.warmth.mean_c
            ways.insert(0, warm / self.warmth.span_k)
        if self.steady:
            ways.insert(0, (stamps_ns - self.begin_ns) / (self.end_ns - self.begin_ns) - 0.5)
        return np.stack(ways, axis=1)


# what each image has of its own

# prior sigma of a stabiliser's crop, of the width, and how long it holds it, s
CROP_SIGMA, CROP_TIME_S = 0.03, 1.0
# of a smaller shift, which wanders smoothly: how long it holds, in units of that time
WANDER_TIMES = 1.5
# prior sigmas of the zoom: of one image, of a stretch, of a turn
ZOOM_IMAGE, ZOOM_STRETCH, ZOOM_TURN = 0.01, 0.02, 0.03


@dataclass(frozen=True)
class Shift(ImageBlock):
    """How far each image's picture is shifted in x and y, px.

    sigma: of the width. CROP_SIGMA as a stabiliser makes it; smaller ones wander smoothly.
    only: the stretches in which it may be; None: in all.
    """

    sigma: float = CROP_SIGMA
    only: frozenset[TurnId] | None = None

    name: ClassVar[str] = 'shift'
    count: ClassVar[int] = 2

    def within(self, stretch: Stretch) -> bool:
        return self.only is None or stretch.turn in self.only

    def columns(self, seen: Seen) -> Floats:
        return np.broadcast_to(np.eye(2)[:, :, None], (2, 2, len(seen.local)))

    def ideal(self, xy: Floats, observed: Observed) -> Floats:
        moved = self.value.get(observed.turn)
        return xy if moved is None else np.asarray(xy - moved[observed.rows])

    def prior_of(self, stretch: Stretch) -> tuple[Floats, Floats]:
        used, apart = stretch.observed.keyframes, _apart(stretch)
        smooth = np.exp(-apart if self.sigma >= CROP_SIGMA else -0.5 * (apart / WANDER_TIMES)**2)
        inner = np.linalg.inv((self.sigma * stretch.tracks.image_size[0])**2 * (
            smooth + 1e-6 * np.eye(len(used))))
        return np.kron(inner, np.eye(2)), self.of(stretch)[used].ravel()


@dataclass(frozen=True)
class Zoom(ImageBlock):
    """By how much each image's picture is larger, of 1."""

    name: ClassVar[str] = 'zoom'

    def columns(self, seen: Seen) -> Floats:
        return seen.from_middle.T[:, None]

    def ideal(self, xy: Floats, observed: Observed) -> Floats:
        larger = self.value.get(observed.turn)
        centre = middle(observed.image_size)
        return xy if larger is None else np.asarray(
            centre + (xy - centre) / (1 + larger[observed.rows]))

    def prior_of(self, stretch: Stretch) -> tuple[Floats, Floats]:
        used = stretch.observed.keyframes
        spread = (ZOOM_STRETCH**2 * np.exp(-_apart(stretch))
                  + ZOOM_IMAGE**2 * np.eye(len(used)) + ZOOM_TURN**2)
        return np.asarray(np.linalg.inv(spread)), self.of(stretch)[used].ravel()


def _apart(stretch: Stretch) -> Floats:
    """Return (k, k) how far the used keyframes are apart, in units of a stabiliser's time."""
    seconds = stretch.tracks.stamps_ns[stretch.observed.keyframes] / 1e9
    return np.asarray(np.abs(seconds[:, None] - seconds) / CROP_TIME_S)


# in the order in which their parameters stand, and in which pictures are undone: that of the
# images first
BLOCKS: tuple[type[Block], ...] = (Lens, Readout, Shake, Shift, Zoom, Smooth, Bend, Drift)


@dataclass(frozen=True)
class Imaging:
    """The present values of all blocks, by name. Those that are not in it do nothing."""

    blocks: Mapping[str, Block]

    @classmethod
    def of(cls, *blocks: Block) -> Imaging:
        """Return the imaging by these blocks."""
        return cls({}).having(*blocks)

    def having(self, *blocks: Block) -> Imaging:
        """Return it with these blocks in the place of those of the same names."""
        found = {**self.blocks, **{block.name: block for block in blocks}}
        return Imaging({kind.name: found[kind.name] for kind in BLOCKS if kind.name in found})

    def without(self, name: str) -> Imaging:
        """Return it without the block of this name."""
        return Imaging({key: block for key, block in self.blocks.items() if key != name})

    @property
    def lens(self) -> Lens:
        """Return the block of the lens."""
        found = self.blocks[Lens.name]
        assert isinstance(found, Lens)
        return found

    @property
    def camera(self) -> Camera:
        """Return the lens."""
        return self.lens.camera

    @property
    def readout_s(self) -> float:
        """Return the time from the first row to the last."""
        found = self.blocks.get(Readout.name)
        return float(found.value[0]) if isinstance(found, Readout) else 0.0

    @property
    def smooth(self) -> Smooth:
        """Return the block of the field."""
        found = self.blocks.get(Smooth.name, Smooth())
        assert isinstance(found, Smooth)
        return found

    @property
    def field(self) -> Field:
        """Return the residual distortion over the picture."""
        smooth = self.smooth
        return Field(self.camera.image_size, (smooth.basis @ smooth.value).reshape(2, -1))

    def of_images(self, name: str) -> Mapping[TurnId, Floats]:
        """Return by stretch (k, c) what a block has of each image; {} where it is not there."""
        found = self.blocks.get(name)
        return found.value if isinstance(found, ImageBlock) else {}

    def steering(self, stretch: Stretch) -> Floats:
        """Return the (3, 3) projection of how the camera turns on what the poses can say about it.

        With Shake, about the axis of turns alone: between two keyframes bumps turn a camera to and
        fro about the other axes, so the difference of the poses does not say how fast.
        """
        shake = self.blocks.get(Shake.name)
        axis = shake.axes.get(stretch.turn) if isinstance(shake, Shake) else None
        return np.eye(3) if axis is None else np.outer(axis, axis)

    @property
    def coupled(self) -> bool:
        """Return whether it counts how poses, and shakes, change the motion of the camera."""
        return abs(self.readout_s) > COUPLED_READOUT_S

    def couples(self, stretch: Stretch) -> bool:
        """Return whether that counts in a stretch: one of few images does not show its motion."""
        return self.coupled and stretch.trajectory.moves

    @property
    def shared(self) -> list[SharedBlock]:
        """Return the free blocks with one value for all stretches."""
        return [block for block in self.blocks.values()
                if isinstance(block, SharedBlock) and not block.held]

    def of_each_image(self, stretch: Stretch) -> list[ImageBlock]:
        """Return the free blocks with a value for each image of a stretch."""
        return [block for block in self.blocks.values() if isinstance(block, ImageBlock)
                and not block.held and (not block.turns or self.couples(stretch))
                and block.within(stretch)]

    @property
    def places(self) -> dict[str, slice]:
        """Return where the parameters of each free block stand among those that are shared."""
        ends = np.cumsum([0, *(block.size for block in self.shared)]).tolist()
        return {block.name: slice(start, end)
                for block, start, end in zip(self.shared, ends, ends[1:], strict=False)}

    @property
    def names(self) -> list[str]:
        """Return the names of the parameters that are shared."""
        return [name for block in self.shared for name in block.names]

    def clipped(self, step: Floats) -> Floats:
        """Return the step (m,) as far as the bounds of the blocks allow."""
        return np.concatenate([np.zeros(0), *(
            block.clipped(step[self.places[block.name]]) for block in self.shared)])

    def moved(self, step: Floats) -> Imaging:
        """Return the imaging after a step (m,) of what is shared."""
        places = self.places
        return self.having(*(block.moved(step[places[block.name]]) for block in self.shared))

    def anchored(self) -> Imaging:
        """Return the imaging where priors that depend on other blocks are at present values."""
        return self.having(*(block.anchored(self) for block in self.blocks.values()))

    def prior(self) -> Quadratic:
        """Return the priors of what is shared, from the present values."""
        size, places = sum(block.size for block in self.shared), self.places
        information, score = np.zeros((size, size)), np.zeros(size)
        for block in self.shared:
            own = places[block.name]
            inner, off = block.prior()
            information[own, own], score[own] = inner, -inner @ off
        return Quadratic.prior(information, score=score)

    def prior_cost(self, stretches: Sequence[Stretch]) -> float:
        """Return what all priors cost at the present values."""
        pairs = [block.prior() for block in self.shared]
        pairs += [block.prior_of(stretch) for stretch in stretches
                  for block in self.of_each_image(stretch) if block.value]
        return sum(float(off @ inner @ off) for inner, off in pairs)

    def ideal_of(self, observed: Observed) -> Floats:
        """Return (n, 2) where the lens alone would see what was observed."""
        xy = observed.xy
        for block in self.blocks.values():
            xy = block.ideal(xy, observed)
        return xy

    def ideal(self, stretch: Stretch) -> Floats:
        """Return (k, t, 2) where the lens alone would see what was measured in a stretch."""
        found, seen = np.full(stretch.tracks.xy.shape, np.nan), stretch.tracks.seen
        found[seen] = self.ideal_of(Observed.of(stretch.turn, stretch.tracks, seen))
        return found

    def seen(self, stretch: Stretch, observed: Observed | None = None) -> Seen:
        """Return where the points of the used observations are, or of other ones."""
        observed, structure = observed or stretch.observed, stretch.structure
        rows, points = observed.rows, structure.points[observed.columns]
        rotated = np.empty((len(rows), 3))
        for row, some in zip(observed.keyframes, observed.images, strict=True):
            rotated[some] = points[some] @ structure.rotations[row].T
        still = rotated + structure.translations[rows]
        late = (observed.xy[:, 1] + 0.5) / self.camera.image_size[1] - 0.5
        if Readout.name not in self.blocks:
            return Seen(stretch, observed, self, rotated, still, still, still * 0, still * 0, late)
        turning, moving = stretch.trajectory.velocity
        shakes = self.of_images(Shake.name).get(stretch.turn)
        turning = turning @ self.steering(stretch)
        by_readout = late[:, None] * (crossed(turning[rows], still) + moving[rows])
        turned, local = self.readout_s * turning[rows], still + self.readout_s * by_readout
        if shakes is not None:
            turned, local = turned + shakes[rows], local + late[:, None] * crossed(
                shakes[rows], still)
        return Seen(stretch, observed, self, rotated, still, local, turned, by_readout, late)

    def as_lens_sees(self, stretch: Self_) -> Self_:
        """Return the stretch with the tracks that the lens alone would have seen.

        All rows at once: that is a global shutter exposed with the middle row.
        """
        xy = self.ideal(stretch)
        if self.readout_s:
            xy = xy - self.row_shift(stretch)
        return replace(stretch, tracks=replace(stretch.tracks, xy=xy))

    def row_shift(self, stretch: Stretch) -> Floats:
        """Return (k, t, 2) px by which each observation is displaced by the readout.

        0 where the stretch has no point for a track, or no pose.
        """
        structure = stretch.structure
        seen = stretch.tracks.seen & structure.registered[:, None] & structure.used.any(axis=0)
        found = self.seen(stretch, Observed.of(stretch.turn, stretch.tracks, seen))
        shift = np.zeros(stretch.tracks.xy.shape)
        shift[seen] = np.nan_to_num(found.projected - self.camera.project(found.still))
        return shift


Self_ = TypeVar('Self_', bound=Stretch)


def middle(image_size: tuple[int, int]) -> Floats:
    """Return (2,) the middle of the picture, px."""
    return (np.array(image_size) - 1) / 2


def imaging_with(camera: Camera, stretches: Sequence[Stretch] = ()) -> Imaging:
    """Return the imaging by a lens, where nothing is known about the other blocks."""
    basis = field_basis(camera)
    return Imaging.of(
        Lens(camera), Readout(), Smooth(np.zeros(basis.shape[1]), basis),
        Shake(axes=steering_axes(stretches)))


def steering_axes(stretches: Sequence[Stretch]) -> dict[TurnId, Floats]:
    """Return the axis about which each stretch is steered, (3,), in the camera's axes.

    A gentle one has that of the sharpest turn; without any, the vertical of upright pictures.
    """
    axes = {stretch.turn: main_axis(stretch.turned) for stretch in stretches}
    turned = {stretch.turn: float(np.degrees(np.ptp(stretch.turned @ axes[stretch.turn])))
              for stretch in stretches}
    sharpest = max(turned, key=lambda turn: turned[turn], default=None)
    upright = np.array([0.0, 1.0, 0.0])
    steered = axes[sharpest] if sharpest and turned[sharpest] > STEERED_DEG else upright
    return {turn: axis if turned[turn] > STEERED_DEG else steered for turn, axis in axes.items()}


def lens_alone(camera: Camera) -> Imaging:
    """Return the imaging by a lens, where no other block is."""
    return Imaging.of(Lens(camera))
