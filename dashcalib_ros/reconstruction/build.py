"""A turn becomes a scene: its focal profile first, then one scene from the best start.

Incremental reconstruction with a free focal length often runs away, and registers every image with
small residuals on the way (FACTS: f = 157 for 1353, 26 of 26 images, 0.85 px). Held at a wrong
focal length it cannot run away; it only explains fewer observations. So the turn is chained at
several held focal lengths, and the cost over *all* its observations tells a good start from
garbage.
"""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from dashcalib_ros.config import SceneConfig, TracksConfig
from dashcalib_ros.reconstruction.adjust import Solver, adjust_step1
from dashcalib_ros.reconstruction.camera import Camera
from dashcalib_ros.reconstruction.chain import chain
from dashcalib_ros.reconstruction.register import register_tracks
from dashcalib_ros.reconstruction.scene import (
    Draft,
    Profile,
    Scene,
    retriangulated,
    truncated_cost,
)
from dashcalib_ros.reconstruction.tracks import Tracks, thinned, track_turn
from dashcalib_ros.turns.turn import Turn

Mask = npt.NDArray[np.bool_]

# focal length / width: 0.256 is 126 degrees across, 1.91 is 29
RATIOS = tuple(0.256 * 1.25**n for n in range(10))
COARSE = (1, 3, 5, 7, 9)
COMPLETIONS = 2
# relative change of the cost that ends an adjustment, where another follows
ROUGH = 1e-3
# columns and rows in which tracks are to be seen in each keyframe
GRID = (6, 3)


def draft_scene(turn: Turn, tracks_config: TracksConfig, config: SceneConfig,
                valid: Mask | None = None, seed: int = 0) -> Draft | None:
    """Track a turn and find where to begin; None when no focal length gives a scene.

    valid: (h, w), False where the ego vehicle is.
    """
    tracks = track_turn(turn, tracks_config, valid)
    if tracks.xy.shape[1] < config.min_tracks or len(tracks.frames) < config.min_images:
        return None
    trials = _trials(tracks, turn.center, config, seed)
    if not trials:
        return None
    profile = _profile_of(trials)
    return Draft(thinned(tracks, config.keyframes), profile, trials[profile.best].camera)


def finish_scene(turn: Turn, draft: Draft, config: SceneConfig, seed: int = 0) -> Scene | None:
    """Reconstruct a turn from its draft; None when that gives no scene.

    turn: needs the images of the draft's keyframes only.
    """
    start, profile = draft.start, draft.profile
    # few short tracks may leave no pair of images enough in common
    scene = (chain_scene(_spread(draft.tracks, config.tracks), turn.center, start, profile,
                         config, seed)
             or chain_scene(_longest(draft.tracks, config.tracks), turn.center, start, profile,
                            config, seed))
    if scene is None:
        return None
    # the neighbours on the profile's grid bound the focal length: the evidence lies between
    reach = (start.fx / 1.3, start.fx * 1.3)
    scene = _refined(scene, config, reach, tolerance=ROUGH)
    by_index = {frame.index: frame.image for frame in turn.frames}
    images = [by_index[int(index)] for index in scene.tracks.frames]
    registered = register_tracks(
        scene.tracks, scene.structure, images, config.patch_half_window, config.max_shift_px)
    scene = retriangulated(replace(scene, tracks=registered), scene.camera,
                           config.error_px, config.min_angle_deg)
    scene = _refined(scene, config, reach)
    return scene if scene.structure.used.any() else None


def chain_scene(tracks: Tracks, center: int, camera: Camera, profile: Profile,
                config: SceneConfig, seed: int) -> Scene | None:
    """Return a first scene at a camera that is known roughly."""
    generous = max(config.error_px, config.chain_error * tracks.image_size[0])
    structure = chain(tracks, camera, generous, config.min_angle_deg, seed)
    if structure is None:
        return None
    return Scene(center, tracks, structure, camera, profile)


def _refined(scene: Scene, config: SceneConfig, reach: tuple[float, float] | None,
             rounds: int = 2, tolerance: float = Solver.tolerance) -> Scene:
    """Adjust and triangulate again in turn."""
    solver = Solver(config.loss_px, config.iterations, tolerance)
    for _ in range(rounds):
        [scene], camera = adjust_step1([scene], scene.camera, solver, reach)
        scene = retriangulated(scene, camera, config.error_px, config.min_angle_deg)
    return scene


def _trials(tracks: Tracks, center: int, config: SceneConfig, seed: int) -> dict[float, Scene]:
    """Return the best scene for each held focal length that has one.

    The longest tracks chain best, as a rule. Where no focal length explains much with them, those
    spread over all keyframes are tried, too.
    """
    few = thinned(tracks, config.profile_keyframes)
    trials = _profile_trials(_longest(few, config.profile_tracks), center, config, seed)
    if not trials or min(map(_cost_of, trials.values())) > config.good_cost:
        others = _profile_trials(_spread(few, config.profile_tracks), center, config, seed)
        for ratio, scene in others.items():
            trials[ratio] = min(trials.get(ratio, scene), scene, key=_cost_of)
    return trials


def _cost_of(scene: Scene) -> float:
    return float(scene.profile.costs[0])


def _profile_trials(tracks: Tracks, center: int, config: SceneConfig, seed: int
                    ) -> dict[float, Scene]:
    """Return a scene for each held focal length that has one, from coarse to fine."""
    trials: dict[float, Scene] = {}
    tried: set[int] = set()

    def attempt(n: int) -> None:
        if n in tried or not 0 <= n < len(RATIOS):
            return
        tried.add(n)
        camera = Camera.centred(tracks.image_size, RATIOS[n] * tracks.image_size[0])
        scene = chain_scene(tracks, center, camera, _NO_PROFILE, config, seed)
        if scene is not None:
            scene = _completed(_refined(scene, config, None, tolerance=ROUGH), config, seed)
            cost = truncated_cost(scene, scene.camera, config.error_px)
            trials[RATIOS[n]] = replace(scene, profile=Profile(
                np.array([RATIOS[n]]), np.array([cost]), int(tracks.seen.sum())))

    for n in COARSE:
        attempt(n)
    if trials:
        best = RATIOS.index(_profile_of(trials).best)
        attempt(best - 1)
        attempt(best + 1)
        # the minimum may have moved to one of them: its other neighbour was tried already
    return trials


def _completed(scene: Scene, config: SceneConfig, seed: int) -> Scene:
    """Chain again where images are missing, now that the distortion is known better.

    A chain without distortion soon breaks behind a wide lens, at the true focal length too.
    """
    for _ in range(COMPLETIONS):
        if scene.structure.registered.all():
            break
        again = chain_scene(scene.tracks, scene.center, scene.camera, scene.profile, config, seed)
        if again is None:
            break
        again = _refined(again, config, None, tolerance=ROUGH)
        if (truncated_cost(again, again.camera, config.error_px)
                >= truncated_cost(scene, scene.camera, config.error_px)):
            break
        scene = again
    return scene


_NO_PROFILE = Profile(np.zeros(0), np.zeros(0), 0)


def _profile_of(trials: dict[float, Scene]) -> Profile:
    ratios = sorted(trials)
    costs = [_cost_of(trials[ratio]) for ratio in ratios]
    return Profile(np.array(ratios), np.array(costs),
                   next(iter(trials.values())).profile.observations)


def _longest(tracks: Tracks, wanted: int) -> Tracks:
    """Return the tracks seen in the most keyframes, in their order."""
    length = tracks.seen.sum(axis=0)
    chosen = np.sort(np.argsort(-length, kind='stable')[:wanted])
    return replace(tracks, xy=tracks.xy[:, chosen])


def _spread(tracks: Tracks, wanted: int) -> Tracks:
    """Return the longest tracks, but those first that are seen where others are few.

    Keyframes lie closest in the middle of a turn, and so the longest tracks do: without this the
    turn's ends hang on a few points each.
    """
    seen = tracks.seen
    width, height = tracks.image_size
    columns, rows = GRID
    keyframe, track = np.nonzero(seen)
    x, y = tracks.xy[keyframe, track].T
    cell = (np.clip(x * columns / width, 0, columns - 1).astype(int)
            + columns * np.clip(y * rows / height, 0, rows - 1).astype(int))
    place = keyframe * columns * rows + cell
    length = seen.sum(axis=0)
    order = np.argsort(-length, kind='stable')
    by_track = np.split(place[np.argsort(track, kind='stable')], np.cumsum(length)[:-1])
    share = wanted * float(np.mean(length)) / (len(seen) * columns * rows)
    crowd = np.zeros(len(seen) * columns * rows)
    chosen: list[int] = []
    for n in order:
        if len(chosen) < wanted and np.mean(crowd[by_track[n]] < share) >= 0.5:
            crowd[by_track[n]] += 1
            chosen.append(int(n))
    spare = np.setdiff1d(order, chosen, assume_unique=True)
    spare = spare[np.argsort(-length[spare], kind='stable')]
    kept = np.sort([*chosen, *spare[:wanted - len(chosen)]]).astype(int)
    return replace(tracks, xy=tracks.xy[:, kept])
