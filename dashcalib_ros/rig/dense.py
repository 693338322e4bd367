# SPDX-License-Identifier: Apache-2.0
"""The pose of every image of a stretch whose scene and lens are known.

A lens needs keyframes far apart, a rig poses at times that its cameras share: between keyframes
0.2 s apart a road shakes a car by a tenth of a degree, twenty times what a pose is known to.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dashcalib_ros.arrays import GreyImage, Mask
from dashcalib_ros.config import Config
from dashcalib_ros.detect.turn import Turn
from dashcalib_ros.input import Frame
from dashcalib_ros.problem.blocks import Imaging, Lens, Readout, Shake, steering_axes
from dashcalib_ros.problem.observations import Structure
from dashcalib_ros.problem.steps import FIRST_RADIUS, State, Stepping, optimised
from dashcalib_ros.reconstruct.register import register_tracks
from dashcalib_ros.reconstruct.scene import Scene, retriangulated
from dashcalib_ros.reconstruct.tracks import spread, track_turn
from dashcalib_ros.solve.solution import Solution

# px: largest errors of the rounds; the first poses are interpolated
ROUNDS_PX = (6.0, 2.0, 2.0)
# before which tracks are registered against one patch each: what is followed from image to image
# drifts, and turns a camera by a twentieth of a degree
REGISTERED = 2
# of each round: twice as many move a rotation by 0.002°, and take a quarter of the time beside
# the single runs
STEPS = 6
# tracks of a stretch: an image sees a few hundred of them
TRACKS = 1200
# times the median residual
LOSS, LEAST_LOSS_PX = 1.0, 0.05


@dataclass(frozen=True)
class Retraced:
    """A scene with every image as a keyframe, and how each of them shakes."""

    scene: Scene
    shake: Shake


def retraced(frames: Sequence[Frame], scene: Scene, solution: Solution, config: Config,
             valid: Mask | None = None) -> Retraced | None:
    """Return a scene with all of these images as keyframes, and the solution's lens.

    Its tracks are without the field, and as imaging_of() sees them. frames: resized as the
    scene's, between its first and its last keyframe. None where they give no tracks.
    """
    turn = Turn(scene.turn.number, frames[0].index, frames[-1].index, 0.0, 0.0, tuple(frames))
    tracks = track_turn(turn, replace(config.tracks, keyframe_motion=0.0), valid)
    if not tracks.xy.shape[1]:
        return None
    tracks = spread(tracks, TRACKS)
    first_ns = scene.tracks.stamps_ns[scene.structure.registered][0]
    rotations, translations = scene.trajectory.at((tracks.stamps_ns - first_ns) / 1e9)
    count = tracks.xy.shape[1]
    return _posed(replace(scene, tracks=tracks, structure=Structure(
        rotations, translations, np.zeros((count, 3)), np.ones(len(tracks.frames), bool),
        np.zeros(tracks.seen.shape, bool))), solution, config, [frame.image for frame in frames])


def posed(scene: Scene, solution: Solution, config: Config) -> Retraced | None:
    """Return a scene with the solution's lens where there are no images: only its keyframes."""
    return _posed(scene, solution, config)


def _posed(scene: Scene, solution: Solution, config: Config, images: Sequence[GreyImage] = ()
           ) -> Retraced | None:
    tracks = scene.tracks
    if solution.field is not None:
        xy, seen = tracks.xy.copy(), tracks.seen
        xy[seen] = solution.field.ideal(xy[seen])
        tracks = replace(tracks, xy=xy)
    found = replace(scene, tracks=tracks, camera=solution.camera)
    imaging = imaging_of(solution, held=True)
    for number, error_px in enumerate(ROUNDS_PX):
        if number == REGISTERED and images:
            tracks = register_tracks(tracks, found.structure, solution.camera, images)
            found = replace(found, tracks=tracks)
        whole = retriangulated(imaging.as_lens_sees(found), solution.camera, error_px,
                              config.scene.min_angle_deg)
        if not whole.structure.used.any():
            return None
        found = replace(whole, tracks=tracks)
        state = State(imaging, (found,))
        loss_px = loss_of(state)
        # the prior of the shakes counts beside the noise
        state = optimised(state, Stepping(loss_px, STEPS, radius=FIRST_RADIUS))
        imaging, found = state.imaging, replace(found, structure=state.stretches[0].structure)
    shake = imaging.blocks[Shake.name]
    assert isinstance(shake, Shake)
    return Retraced(found, shake)


def loss_of(state: State) -> float:
    """Return the scale of the Cauchy loss, px."""
    off = np.concatenate([np.linalg.norm(seen.off, axis=1) for seen in state.seen])
    return max(LOSS * float(np.median(off)), LEAST_LOSS_PX)


def imaging_of(solution: Solution, held: bool = False) -> Imaging:
    """Return what takes a solution's pictures, the field apart, as it was solved.

    held: what the images share does not move.
    """
    return Imaging.of(
        Lens(solution.camera.widened(), held=held),
        Readout(np.array([solution.readout_s]), held=held),
        Shake(axes=steering_axes(solution.scenes), readout_s=solution.readout_s))
