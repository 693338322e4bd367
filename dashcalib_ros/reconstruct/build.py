"""A turn becomes a scene: its focal profile first, then one scene from the best start.

Incremental reconstruction with a free focal length often diverges, although it registers every
image with small residuals (docs/notebook/lessons.md: f = 157 for 1353). With a wrong focal length
held fixed it cannot diverge; it only explains fewer observations. So the turn is chained at
several fixed focal lengths, and the one with the lowest cost over *all* observations is the start.
"""
from __future__ import annotations

from collections.abc import Set
from dataclasses import replace

import numpy as np

from dashcalib_ros.arrays import Mask
from dashcalib_ros.camera import Camera, searched
from dashcalib_ros.config import Config, SceneConfig
from dashcalib_ros.detect.turn import Turn, TurnId
from dashcalib_ros.reconstruct.adjust import ROUGH, Free, Solver, adjust
from dashcalib_ros.reconstruct.chain import chain
from dashcalib_ros.reconstruct.register import register_tracks
from dashcalib_ros.reconstruct.scene import (
    Draft,
    Profile,
    Scene,
    Start,
    retriangulated,
    truncated_cost,
)
from dashcalib_ros.reconstruct.tracks import Tracks, thinned, track_turn

# focal length / width; a lens that seems longer is no fisheye: 90 degrees across, or less
WIDE = 0.5
# how often a scene that leaves images or much else unexplained is chained anew, at the most
COMPLETIONS = 2
# columns and rows in which tracks are to be seen in each keyframe
GRID = (6, 3)
# a turn with fewer tracks is not tried
MIN_TRACKS = 80
# px^2 per observation; what costs more is chained anew, and may be another kind of lens
GOOD_COST = 1.2
# of the cost of the chain before; one that costs more is no better
WORTH = 0.95


def draft_scene(turn: Turn, config: Config, valid: Mask | None = None) -> Draft | None:
    """Track a turn and find the focal length to start from; None when none gives a scene.

    valid: (h, w), False where the ego vehicle is.
    """
    tracks, settings = track_turn(turn, config.tracks, valid), config.scene
    if tracks.xy.shape[1] < MIN_TRACKS or len(tracks.frames) < settings.min_images:
        return None
    found: list[Scene] = []
    for model in searched(config.model):
        if found and not _may_be_another(found[0].profile, settings):
            break
        trials = _trials(tracks, turn, config, model)
        if trials:
            profile = _profile_of(trials)
            found.append(replace(trials[profile.best], profile=profile))
    if not found:
        return None
    if len(found) > 1:
        # at the focal lengths of the grid, the right kind may look worse
        found = [_refined(scene, settings, _around(scene.camera), Solver.tolerance)
                 for scene in found]
    # min() returns the first one of equals: the simplest
    best = min(found, key=lambda scene: truncated_cost(scene, scene.camera, settings.error_px))
    return Draft(thinned(tracks, settings.keyframes), Start(best.profile, best.camera),
                 tuple(Start(scene.profile, scene.camera) for scene in found if scene is not best))


def _around(camera: Camera) -> tuple[float, float]:
    """Return the focal lengths between which the minimum may lie: the profile's grid is coarse."""
    return camera.fx / 1.3, camera.fx * 1.3


def _may_be_another(profile: Profile, config: SceneConfig) -> bool:
    """Return whether a pinhole's profile leaves it open that the lens is a fisheye."""
    return profile.best < WIDE or float(profile.costs.min()) > GOOD_COST


def finish_scene(turn: Turn, draft: Draft, config: Config) -> Scene | None:
    """Reconstruct a turn from its draft; None when that gives no scene.

    turn: needs the images of the draft's keyframes only.
    """
    start, settings = draft.start.camera, config.scene
    scene = _begun(draft, turn.id, config)
    if scene is None:
        return None
    scene, reach = replace(scene, rivals=draft.rivals), _around(start)
    scene = _refined(scene, settings, reach)
    by_index = {frame.index: frame.image for frame in turn.frames}
    images = [by_index[int(index)] for index in scene.tracks.frames]
    registered = register_tracks(scene.tracks, scene.structure, scene.camera, images)
    scene = retriangulated(replace(scene, tracks=registered), scene.camera,
                           settings.error_px, settings.min_angle_deg)
    scene = _refined(scene, settings, reach, Solver.tolerance)
    return scene if scene.structure.used.any() else None


def _begun(draft: Draft, turn: TurnId, config: Config) -> Scene | None:
    """Return a first scene from spread tracks, or from the longest if images are left out.

    Where tracks are short, no pair of images may share enough spread ones, or the chain breaks.
    """
    found = []
    for choose in (_spread, _longest):
        scene = chain_scene(choose(draft.tracks, config.scene.tracks), turn, draft.start.camera,
                            draft.start.profile, config.scene, config.seed)
        if scene is not None:
            found.append(scene)
            if scene.structure.registered.all():
                break
    return max(found, key=lambda scene: int(scene.structure.registered.sum()), default=None)


def chain_scene(tracks: Tracks, turn: TurnId, camera: Camera, profile: Profile,
                config: SceneConfig, seed: int) -> Scene | None:
    """Return a first scene with a camera that is known roughly; None if no pair starts a chain."""
    generous = max(config.error_px, config.chain_error * tracks.image_size[0])
    structure = chain(tracks, camera, generous, config.min_angle_deg, seed)
    if structure is None:
        return None
    return Scene(turn, tracks, structure, camera, profile)


def _refined(scene: Scene, config: SceneConfig, reach: tuple[float, float] | None,
             tolerance: float = ROUGH) -> Scene:
    """Return the scene after an adjustment and triangulation."""
    solver = Solver(config.loss_px, config.iterations, tolerance)
    free: Free = 'first distortion' if reach is None else 'one focal length'
    [scene], camera = adjust([scene], scene.camera, solver, free, reach)
    return retriangulated(scene, camera, config.error_px, config.min_angle_deg)


def _trials(tracks: Tracks, turn: Turn, config: Config, model: type[Camera]
            ) -> dict[float, Scene]:
    """Return the best scene for each focal length held fixed; none for one without a scene.

    In most turns the longest tracks chain best. If they leave images out, tracks spread over all
    keyframes are tried, too.
    """
    settings = config.scene
    few = thinned(tracks, settings.profile_keyframes)
    trials = _profile_trials(_longest(few, settings.profile_tracks), turn, config, model)
    if not trials or not min(trials.values(), key=_cost_of).structure.registered.all():
        others = _profile_trials(_spread(few, settings.profile_tracks), turn, config, model)
        for ratio, scene in others.items():
            trials[ratio] = min(trials.get(ratio, scene), scene, key=_cost_of)
    return trials


def _cost_of(scene: Scene) -> float:
    return float(scene.profile.costs[0])


def _profile_trials(tracks: Tracks, turn: Turn, config: Config, model: type[Camera]
                    ) -> dict[float, Scene]:
    """Return the scenes at focal lengths held fixed: every second one, then around the best.

    What is far from the best costs as much time, and changes only how bad it is: it is adjusted
    once, and not even begun where those on both sides of the best are worse. With a wide lens, a
    chain without distortion breaks soon, even at the true focal length. So the best is chained
    anew with the distortion that it has found, and its neighbours begin with that.
    """
    settings, ratios = config.scene, model.focal_ratios
    width, observations = tracks.image_size[0], int(tracks.seen.sum())
    found: dict[int, Scene] = {}

    def adjusted(scene: Scene) -> Scene:
        scene = _refined(scene, settings, None)
        cost = truncated_cost(scene, scene.camera, settings.error_px)
        return replace(scene, profile=Profile(
            np.array([scene.camera.fx / width]), np.array([cost]), observations))

    def chained(camera: Camera) -> Scene | None:
        scene = chain_scene(tracks, turn.id, camera, _NO_PROFILE, settings, config.seed)
        return scene and adjusted(scene)

    def begin(n: int, like: Camera) -> None:
        scene = chained(like.with_focal(ratios[n] * width))
        if scene is not None:
            found[n] = min(found.get(n, scene), scene, key=_cost_of)

    def complete(n: int) -> None:
        found[n] = adjusted(found[n])
        for _ in range(COMPLETIONS):
            if found[n].structure.registered.all() and _cost_of(found[n]) <= GOOD_COST:
                break
            other = chained(found[n].camera)
            other = other and adjusted(other)
            if other is None or _cost_of(other) > WORTH * _cost_of(found[n]):
                break
            found[n] = other

    def best() -> int:
        return min(found, key=lambda n: (_cost_of(found[n]), n))

    coarse = range(1, len(ratios), 2)
    begun: set[int] = set()
    wanted: Set[int] = set(coarse[1:-1])
    while wanted:
        for n in sorted(wanted):
            begin(n, model.centred(tracks.image_size, width))
        begun |= wanted
        wanted = (set(coarse) & {best() - 2, best() + 2} if found else set(coarse)) - begun
    completed: set[int] = set()
    compared: set[int] = set()
    while found:
        n = best()
        near = {n - 1, n + 1} & set(range(len(ratios))) - completed - compared
        if n not in completed:
            complete(n)
            completed.add(n)
        elif near:
            for other in sorted(near):
                if other not in found or _cost_of(found[other]) > GOOD_COST:
                    begin(other, found[n].camera)
                if other in found:
                    found[other] = adjusted(found[other])
            compared |= near
        elif not found[n].profile.tells and (rest := found.keys() - completed):
            for other in sorted(rest):
                complete(other)
            completed |= rest
        else:
            break
    return {ratios[n]: scene for n, scene in found.items()}


_NO_PROFILE = Profile(np.zeros(0), np.zeros(0), 0)


def _profile_of(trials: dict[float, Scene]) -> Profile:
    ratios = sorted(trials)
    costs = [_cost_of(trials[ratio]) for ratio in ratios]
    return Profile(np.array(ratios), np.array(costs),
                   next(iter(trials.values())).profile.observations)


def _longest(tracks: Tracks, wanted: int) -> Tracks:
    """Return the tracks that are seen in the most keyframes."""
    length = tracks.seen.sum(axis=0)
    chosen = np.sort(np.argsort(-length, kind='stable')[:wanted])
    return replace(tracks, xy=tracks.xy[:, chosen])


def _spread(tracks: Tracks, wanted: int) -> Tracks:
    """Return long tracks that are spread evenly over the keyframes and the picture.

    Keyframes lie closest in the middle of a turn, so the longest tracks do, too: with those alone,
    the poses at the turn's ends would be determined by few points.
    """
    seen = tracks.seen
    width, height = tracks.image_size
    columns, rows = GRID
    keyframe, track = np.nonzero(seen)
    x, y = tracks.xy[keyframe, track].T
    cell = (np.clip(x * columns / width, 0, columns - 1).astype(int)
            + columns * np.clip(y * rows / height, 0, rows - 1).astype(int))
    cells = keyframe * columns * rows + cell
    length = seen.sum(axis=0)
    order = np.argsort(-length, kind='stable')
    by_track = np.split(cells[np.argsort(track, kind='stable')], np.cumsum(length)[:-1])
    share = wanted * float(np.mean(length)) / (len(seen) * columns * rows)
    count = np.zeros(len(seen) * columns * rows)
    chosen: list[int] = []
    for n in order:
        if len(chosen) < wanted and np.mean(count[by_track[n]] < share) >= 0.5:
            count[by_track[n]] += 1
            chosen.append(int(n))
    spare = np.setdiff1d(order, chosen, assume_unique=True)
    spare = spare[np.argsort(-length[spare], kind='stable')]
    kept = np.sort([*chosen, *spare[:wanted - len(chosen)]]).astype(int)
    return replace(tracks, xy=tracks.xy[:, kept])
