# SPDX-License-Identifier: Apache-2.0
"""The focal profile of a turn: how well each focal length, held fixed, explains its tracks.

Incremental reconstruction with a free focal length often diverges, although it registers every
image with small residuals (docs/lessons.md: f = 157 for 1353). With a wrong focal length
held fixed it cannot diverge; it only explains fewer observations. So the turn is chained at
several fixed focal lengths, and the one with the lowest cost over *all* observations is the start.
"""
from __future__ import annotations

from collections.abc import Iterable, Set
from dataclasses import replace

import numpy as np

from dashcalib_ros.camera import Camera
from dashcalib_ros.config import Config
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.problem.observations import Tracks
from dashcalib_ros.reconstruct.adjust import refined
from dashcalib_ros.reconstruct.chain import chain_scene
from dashcalib_ros.reconstruct.scene import Profile, Scene, truncated_cost
from dashcalib_ros.reconstruct.tracks import longest, spread, thinned

# how often a scene that leaves images or much else unexplained is chained anew, at most
COMPLETIONS = 2
# px^2 per observation; what costs more is chained anew
GOOD_COST = 1.2
# of the cost of the chain before; one that costs more is not better
WORTH = 0.95
NO_PROFILE = Profile(np.zeros(0), np.zeros(0), 0)


def best_trial(tracks: Tracks, turn: TurnId, config: Config, model: type[Camera]) -> Scene | None:
    """Return the scene at the best focal length held fixed, with its profile; None for none.

    In most turns the longest tracks chain best. If they leave images out, tracks spread over all
    keyframes are tried, too.
    """
    few, count = thinned(tracks, config.scene.profile_keyframes), config.scene.profile_tracks
    scenes = _Trials(longest(few, count), turn, config, model).scenes()
    if not scenes or not min(scenes.values(), key=_cost_of).structure.registered.all():
        others = _Trials(spread(few, count), turn, config, model).scenes()
        scenes |= {ratio: min(scenes.get(ratio, scene), scene, key=_cost_of)
                   for ratio, scene in others.items()}
    if not scenes:
        return None
    profile = profile_of(scenes)
    return replace(scenes[profile.best], profile=profile)


def profile_of(scenes: dict[float, Scene]) -> Profile:
    """Return the profile of scenes at focal lengths over the width held fixed."""
    ratios = sorted(scenes)
    return Profile(np.array(ratios), np.array([_cost_of(scenes[ratio]) for ratio in ratios]),
                   next(iter(scenes.values())).profile.observations)


def _cost_of(scene: Scene) -> float:
    return float(scene.profile.costs[0])


class _Trials:
    """Scenes of the same tracks at the focal lengths of a model's grid, held fixed.

    What is far from the best costs as much time, and changes only how bad it is: it is adjusted
    once, and not even begun where those on both sides of the best are worse. With a wide lens, a
    chain without distortion breaks soon, even at the true focal length. So the best is chained
    anew with the distortion that it has found, and its neighbours begin with that.
    """

    def __init__(self, tracks: Tracks, turn: TurnId, config: Config, model: type[Camera]) -> None:
        self._tracks, self._turn, self._config, self._model = tracks, turn, config, model
        self._ratios, self._width = model.focal_ratios, tracks.image_size[0]
        # by their places in the grid
        self._found: dict[int, Scene] = {}

    def scenes(self) -> dict[float, Scene]:
        """Return the scenes, by focal length over width; none for one without a scene."""
        self._begin_every_second()
        self._settle_around_the_best()
        return {self._ratios[n]: scene for n, scene in self._found.items()}

    def _begin_every_second(self) -> None:
        start = self._model.centred(self._tracks.image_size, self._width)
        coarse = range(1, len(self._ratios), 2)
        begun: set[int] = set()
        wanted: Set[int] = set(coarse[1:-1])
        while wanted:
            self._begin(wanted, start)
            begun |= wanted
            beside = {self._best() - 2, self._best() + 2} if self._found else set(coarse)
            wanted = set(coarse) & beside - begun

    def _settle_around_the_best(self) -> None:
        completed: set[int] = set()
        compared: set[int] = set()
        while self._found:
            n = self._best()
            near = {n - 1, n + 1} & set(range(len(self._ratios))) - completed - compared
            rest = self._found.keys() - completed
            if n not in completed:
                self._complete(n)
                completed.add(n)
            elif near:
                self._begin([other for other in near if other not in self._found
                             or _cost_of(self._found[other]) > GOOD_COST], self._found[n].camera)
                for other in near & self._found.keys():
                    self._found[other] = self._adjusted(self._found[other])
                compared |= near
            elif rest and not self._found[n].profile.tells:
                for other in rest:
                    self._complete(other)
                completed |= rest
            else:
                break

    def _best(self) -> int:
        return min(self._found, key=lambda n: (_cost_of(self._found[n]), n))

    def _begin(self, places: Iterable[int], like: Camera) -> None:
        for n in places:
            scene = self._chained(like.with_focal(self._ratios[n] * self._width))
            if scene is not None:
                self._found[n] = min(self._found.get(n, scene), scene, key=_cost_of)

    def _complete(self, n: int) -> None:
        scene = self._adjusted(self._found[n])
        for _ in range(COMPLETIONS):
            if scene.structure.registered.all() and _cost_of(scene) <= GOOD_COST:
                break
            other = self._chained(scene.camera)
            other = other and self._adjusted(other)
            if other is None or _cost_of(other) > WORTH * _cost_of(scene):
                break
            scene = other
        self._found[n] = scene

    def _chained(self, camera: Camera) -> Scene | None:
        scene = chain_scene(self._tracks, self._turn, camera, NO_PROFILE, self._config)
        return scene and self._adjusted(scene)

    def _adjusted(self, scene: Scene) -> Scene:
        settings = self._config.scene
        scene = refined(scene, settings, None)
        cost = truncated_cost(scene, scene.camera, settings.error_px)
        return replace(scene, profile=Profile(
            np.array([scene.camera.fx / self._width]), np.array([cost]),
            int(self._tracks.seen.sum())))
