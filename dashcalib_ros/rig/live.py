# SPDX-License-Identifier: Apache-2.0
"""A rig of turns that were reconstructed already, without their images, as a live drive has them.

Only keyframes have poses then: between them the car shakes, which the noise contains.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from dashcalib_ros.config import Config
from dashcalib_ros.detect.turn import TurnId
from dashcalib_ros.input.motion import WHEELS_SIGMA, Samples
from dashcalib_ros.judge.calibration import Level
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.rig.dense import posed
from dashcalib_ros.rig.paths import CameraPaths, camera_paths, coarse_paths, ordered
from dashcalib_ros.rig.placed import Alone, RigCalibration, rig_of_paths
from dashcalib_ros.rig.start import Metres, aligned
from dashcalib_ros.solve import solve
from dashcalib_ros.solve.solution import Solution

# s; clocks of one car that are dates differ by less
CLOCKS_S = 60.0


def rig_of_scenes(scenes: Mapping[str, Sequence[Scene]], levels: Mapping[str, Level], base: str,
                  since_s: float, speed: Samples | None, config: Config,
                  clocks_s: float = CLOCKS_S) -> RigCalibration:
    """Return where cameras sit whose stamps are of about one clock, to clocks_s.

    scenes: by the cameras' names, each once. levels: of their lenses. since_s: stamp from which on
    scenes say where the cameras sit; earlier ones say what the lenses are. speed: of the car, m/s.
    """
    solutions = {name: _solved(each, config) for name, each in scenes.items()}
    # a stamp of today has no microseconds as a float
    start_s = min((int(scene.tracks.stamps_ns[0]) for each in scenes.values() for scene in each),
                  default=0) / 1e9

    def newer(paths: CameraPaths) -> CameraPaths:
        return replace(paths, scenes=tuple(
            scene for scene in paths.scenes if scene.seconds[0] + start_s >= since_s))

    found = {name: newer(coarse_paths(name, each, start_s)) for name, each in solutions.items()}
    turned = {name: aligned(found[name], found[base], 0.0, clocks_s)
              for name in scenes if name != base}
    paths = {name: newer(_paths(name, each, scenes[name], start_s, config))
             for name, each in solutions.items() if each is not None}
    alone = {name: Alone(name, levels[name], start_s, len(each.scenes))
             for name, each in found.items()}
    return rig_of_paths(
        alone, base, turned, paths,
        None if speed is None else Metres.by(speed, start_s, WHEELS_SIGMA), config.rig)


def _solved(scenes: Sequence[Scene], config: Config) -> Solution | None:
    # several runs of a calibrator count their images each from 0
    own = [replace(scene, turn=TurnId.at(number)) for number, scene in enumerate(scenes)]
    return solve(own, config) if own else None


def _paths(name: str, solution: Solution, scenes: Sequence[Scene], start_s: float, config: Config
           ) -> CameraPaths:
    # as they were seen: a solution has them as a lens alone would have seen them
    stretches = [posed(replace(each, tracks=scenes[each.turn.number].tracks), solution, config)
                 for each in ordered(solution)]
    return camera_paths(name, solution, [each for each in stretches if each is not None], start_s)
