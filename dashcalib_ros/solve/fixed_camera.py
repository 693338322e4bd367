"""Tests of a fixed camera: whether the picture shifts, zooms or is bent locally.

Each is a few more parameters of the linearised problem: a shift and a zoom of each image, a smooth
field of displacements over the picture that all images share. What they gain is compared with what
chance would gain, each track counted as one measurement: the ratio is about 1 for a fixed camera,
and the largest one names what is wrong. A stabilised video's shift can be taken out
(stabiliser.py).
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from dashcalib_ros.arrays import Floats, Ints
from dashcalib_ros.camera import Camera
from dashcalib_ros.config import IntrinsicsConfig
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.reconstruct.scene import Scene, projected_px
from dashcalib_ros.solve.field import FoundField
from dashcalib_ros.solve.normal import (
    IMAGE,
    Further,
    ImagePrior,
    Normal,
    normal_equations,
    used_keyframes,
)
from dashcalib_ros.solve.prior import wider_prior
from dashcalib_ros.solve.quadratic import Quadratic, noise_of
from dashcalib_ros.solve.shutter import readout_parameter

Kind = Literal['shift', 'zoom', 'bend']

# columns and rows over the picture of places at which a local bend is estimated
BENDS = (5, 4)
# prior sigma of the bend at each of them, px
BEND_PX = 3.0
# prior sigma of what is left of a rolling shutter's readout, s
READOUT_S = 3.0
# prior sigmas of the zoom: of one image, of a stretch, of a turn
ZOOM_IMAGE, ZOOM_STRETCH, ZOOM_TURN = 0.01, 0.02, 0.03
# prior sigma of a stabiliser's crop, of the width, and how long it holds it, s
CROP_SIGMA, CROP_TIME_S = 0.03, 1.0
# times what chance gains; more is clear. Fixed cameras have 0.9 to 1.5 for the shift, 0.9 to 1.6
# for the zoom (behind glass and real ones, too; one of 6 % over a small, noisy drive 2.7), and
# kitti03, by its own rectification, 4 for the bend
CLEAR: Mapping[Kind, float] = {'shift': 2.0, 'zoom': 2.0, 'bend': 8.0}
# of one turn alone, where chance gains up to 2.1
CLEAR_ZOOM_IN_ONE_TURN = 3.0
# what is left of a rolling shutter comes to 1.3 to 2.4; and after a stabiliser was taken out
CLEAR_ROLLING_SHIFT, LEFT_SHIFT = 2.7, 4.0

# by turn: (k, 2) shifts of the keyframes' pictures that were taken out of the tracks, px
Crops = Mapping[TurnId, Floats]


@dataclass(frozen=True)
class FixedCameraTest:
    """Whether the camera is fixed, or its picture moves in one way.

    strength: what the parameters of this kind gain, over what chance would gain; more than limit
    is clear. size: the root mean square of the shift or the field, px, or of the zoom. by_turn:
    the mean zoom of each turn; empty for other kinds.
    """

    kind: Kind
    strength: float
    limit: float
    size: float
    by_turn: Mapping[TurnId, float]

    @property
    def clear(self) -> bool:
        """Return whether chance does not explain it; so for a strength of NaN."""
        return not self.strength <= self.limit


@dataclass(frozen=True)
class Step:
    """A Gauss-Newton step with more parameters than the camera's.

    gain: by how much it lowers the cost, at unit noise; chance: how much noise alone would, each
    track counted as one measurement. shared: (s,) of the camera, of the wider model and of what
    follows it; images: (p,) of each scene's free image parameters.
    """

    gain: float
    chance: float
    shared: Floats
    images: tuple[Floats, ...]

    def strength(self, base: Step) -> float:
        """Return what this step gains over one without its parameters, over what chance would."""
        return (self.gain - base.gain) / max(self.chance - base.chance, 1e-9)


@dataclass(frozen=True)
class Problem:
    """The linearised problem of all scenes, about the camera and all that may move in its picture.

    own: the number of the camera's parameters; prior: about all that turns share, at unit noise.
    noise: variance of a residual, px^2.
    """

    scenes: tuple[Scene, ...]
    normals: tuple[Normal, ...]
    own: int
    prior: Quadratic
    noise: float

    def solved(self, images: Sequence[ImagePrior] | None, shared: Sequence[int],
               inflation: float = 1.0) -> Step:
        """Return the step with these parameters free; images: a prior for each scene.

        shared: indices of those behind the camera's own. inflation: of the noise: it makes the
        camera's prior count more where the present solution is far from the right one.
        """
        free, noise = np.array([*range(self.own), *shared]), self.noise * inflation
        gain = chance = 0.0
        costs = [self.prior.of(free)]
        for n, normal in enumerate(self.normals):
            cost = normal.shared if images is None else images[n].eliminated(normal)
            costs.append(cost.of(free).at_noise(noise))
            if images is not None:
                own = images[n].of(normal)
                gain += float(own.score @ own.covariance @ own.score) / noise
                chance += own.chance / noise
        total = Quadratic.together(costs)
        step = total.covariance @ total.score
        of_images = () if images is None else tuple(
            each.step(normal, free, step)
            for each, normal in zip(images, self.normals, strict=True))
        return Step(gain + float(total.score @ step), chance + total.chance, step, of_images)


def problem_of(scenes: Sequence[Scene], camera: Camera, centred: Camera, loss_px: float,
               config: IntrinsicsConfig, further: Sequence[Further] = ()) -> Problem:
    """Return the linearised problem of scenes at their solution.

    centred: the camera that priors are about. further: what turns share beside the wider model.
    """
    normals = tuple(normal_equations(scene, camera, loss_px, further, by_image=True)
                    for scene in scenes)
    return Problem(tuple(scenes), normals, len(camera.names()),
                   wider_prior(camera, centred, config, further),
                   noise_of([normal.cost for normal in normals]))


def shift_priors(problem: Problem, crops: Crops) -> list[ImagePrior]:
    """Return for each scene the prior of its images' shifts.

    crops: shifts that were taken out of the tracks already; empty for none.
    """
    return [shift_prior(scene, problem.noise, crops.get(scene.turn))
            for scene in problem.scenes]


def shift_prior(scene: Scene, noise: float, crop: Floats | None = None) -> ImagePrior:
    """Return the prior of the shifts of a scene's images: smooth in time.

    noise: variance of a residual, px^2. crop: (k, 2) what was taken out of the tracks already, px.
    """
    keyframes = used_keyframes(scene)
    spread = (CROP_SIGMA * scene.tracks.image_size[0])**2 * (
        np.exp(-_apart(scene)) + 1e-6 * np.eye(len(keyframes)))
    inner = np.asarray(np.linalg.inv(spread) * noise, np.float64)
    zero = np.zeros_like(inner)
    values = np.zeros(2 * len(keyframes)) if crop is None else crop[keyframes].T.ravel()
    return ImagePrior(_indices(keyframes, 0, 1), np.block([[inner, zero], [zero, inner]]), values)


def _zoom_prior(scene: Scene, noise: float) -> ImagePrior:
    """Return the prior of the zooms of a scene's images."""
    keyframes = used_keyframes(scene)
    spread = (ZOOM_STRETCH**2 * np.exp(-_apart(scene))
              + ZOOM_IMAGE**2 * np.eye(len(keyframes)) + ZOOM_TURN**2)
    precision = np.asarray(np.linalg.inv(spread) * noise, np.float64)
    return ImagePrior(_indices(keyframes, 2), precision, np.zeros(len(keyframes)))


def _apart(scene: Scene) -> Floats:
    """Return (k, k) how far the used keyframes are apart, in units of a stabiliser's time."""
    seconds = scene.tracks.stamps_ns[used_keyframes(scene)] / 1e9
    return np.asarray(np.abs(seconds[:, None] - seconds) / CROP_TIME_S)


def _indices(keyframes: Ints, *components: int) -> Ints:
    """Return the indices of these components among the images' parameters."""
    return np.concatenate([IMAGE * np.arange(len(keyframes)) + component
                           for component in components])


def fixed_camera_tests(scenes: Sequence[Scene], camera: Camera, centred: Camera, loss_px: float,
                       config: IntrinsicsConfig, crops: Crops | None = None, bent: bool = True,
                       rolling: bool = False, found: FoundField | None = None
                       ) -> tuple[FixedCameraTest, ...]:
    """Return the tests whether the camera is a fixed one, the clearest that it is not first.

    centred: the camera that priors are about. crops: of a stabilised video, as taken out already.
    bent: False leaves out the local bend. rolling: a rolling shutter was taken out: what is left
    of it counts as one still. found: the field that no lens model has: likewise.
    """
    further = [readout_parameter(camera, READOUT_S)] * rolling
    if found is not None:
        further.append(found.further(camera))
    free = sum(len(each.sigmas) for each in further)
    if bent:
        further.append(Further(lambda scene: _bends(scene, camera),
                               np.full(2 * BENDS[0] * BENDS[1], BEND_PX)))
    problem = problem_of(scenes, camera, centred, loss_px, config, further)
    count, lens = problem.own, len(camera.widened().names())
    wide = range(count, lens + free)
    shifts = shift_priors(problem, crops or {})
    zooms = [_zoom_prior(scene, problem.noise) for scene in scenes]
    fixed = problem.solved(None, wide)
    # what a stabiliser's removal leaves over makes sigma larger, and may be larger itself
    limit = LEFT_SHIFT if crops else CLEAR_ROLLING_SHIFT if rolling else CLEAR['shift']
    tests = [_test('shift', problem.solved(shifts, wide), fixed, scenes, limit),
             _test('zoom', problem.solved(zooms, wide), fixed, scenes,
                   CLEAR['zoom'] if len(scenes) > 1 else CLEAR_ZOOM_IN_ONE_TURN)]
    if bent:
        # a stabilised picture goes on moving
        moving = shifts if crops else None
        everything = range(count, len(problem.prior.score))
        tests.append(_test('bend', problem.solved(moving, everything),
                           problem.solved(moving, wide), scenes, CLEAR['bend']))
    return tuple(sorted(tests, key=lambda each: -each.strength / each.limit))


def _test(kind: Kind, step: Step, base: Step, scenes: Sequence[Scene], limit: float
          ) -> FixedCameraTest:
    """Return what a step tells. base: the step without the parameters of this kind."""
    parts = step.images if kind != 'bend' else (step.shared[len(base.shared):],)
    turns = {scene.turn: float(part.mean()) for scene, part in zip(scenes, parts, strict=False)}
    return FixedCameraTest(kind, step.strength(base), limit,
                           float(np.sqrt(np.mean(np.square(np.concatenate(parts))))),
                           turns if kind == 'zoom' else {})


def largest_crop(crops: Crops) -> float:
    """Return how far the crop moved at the most, from its middle, px."""
    paths = np.concatenate(list(crops.values()))
    return float(np.abs(paths - np.median(paths, axis=0)).max())


def _bends(scene: Scene, camera: Camera) -> Floats:
    """Return (n, 2, 2 f) derivatives by a smooth field's displacements at f places.

    The weights of the places at an observation sum to 1.
    """
    size = np.array(scene.tracks.image_size)
    # not as observed: errors would correlate with the weights
    places = projected_px(scene, camera) / size
    columns, rows = ((np.arange(count) + 0.5) / count for count in BENDS)
    across = np.exp(-0.5 * ((places[..., :1] - columns) * BENDS[0])**2)
    down = np.exp(-0.5 * ((places[..., 1:] - rows) * BENDS[1])**2)
    weight = (across[..., :, None] * down[..., None, :]).reshape(len(places), 1, -1)
    weight /= np.maximum(weight.sum(axis=-1, keepdims=True), 1e-9)
    zero = np.zeros_like(weight)
    return np.concatenate([np.concatenate([weight, zero], axis=-1),
                           np.concatenate([zero, weight], axis=-1)], axis=1)
