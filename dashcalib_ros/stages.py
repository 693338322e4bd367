"""The four stages, from images to a calibration; calibrator.py schedules them.

detect: frames -> turns. reconstruct: a turn -> its scene. solve: scenes -> one camera with its
covariance. judge: that -> a calibration with its verdict. Their results depend on their arguments
only. reconstruct and solve load COLMAP when they are called.
"""
from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

from dashcalib_ros.arrays import Mask
from dashcalib_ros.camera import Camera
from dashcalib_ros.config import Config
from dashcalib_ros.detect import Turn
from dashcalib_ros.detect.detection import Detection
from dashcalib_ros.errors import InputError
from dashcalib_ros.input import Frame
from dashcalib_ros.input.motion import SensorStream
from dashcalib_ros.input.scale import Scale
from dashcalib_ros.judge import Calibration, Check, Odometry, Poses, Reading, Verdict
from dashcalib_ros.judge.conclude import Evidence, conclude
from dashcalib_ros.judge.witnesses import Asked
from dashcalib_ros.reconstruct.scene import Draft, Scene
from dashcalib_ros.solve.solution import Solution

Progress = Callable[[str, float], None]


def detect(frames: Iterable[Frame], config: Config, mask: Mask | None = None) -> Detection:
    """Find the turns of a drive. For a stream, call Detection.push() for each frame.

    mask: (h, w), False where the ego vehicle is. Raises InputError when the images change size.
    """
    detection = Detection(config, mask)
    for frame in frames:
        detection.push(frame)
    detection.finish()
    return detection


def reconstruct(turn: Turn, config: Config, valid: Mask | None = None) -> Scene | None:
    """Reconstruct one turn; None where its pictures give no scene.

    valid: (h, w), False where the ego vehicle is; None for everywhere.
    """
    begun = draft(turn, config, valid)
    return None if begun is None else finish(turn, config, begun)


def draft(turn: Turn, config: Config, valid: Mask | None = None) -> Draft | None:
    """Do the first half of reconstruct(): the tracks, and the focal length to start from."""
    from dashcalib_ros.reconstruct.build import draft_scene
    with _numerical_failures(turn):
        return draft_scene(turn, config, valid)
    return None


def finish(turn: Turn, config: Config, begun: Draft) -> Scene | None:
    """Do the second half of reconstruct(); the turn needs the images of begun's keyframes only."""
    from dashcalib_ros.reconstruct.build import finish_scene
    with _numerical_failures(turn):
        return finish_scene(turn, begun, config)
    return None


@contextlib.contextmanager
def _numerical_failures(turn: Turn) -> Iterator[None]:
    """Catch numerical failures from bad pictures: such a turn has no scene, others may."""
    import cv2
    try:
        yield
    except (np.linalg.LinAlgError, cv2.error) as error:
        # shown with --verbose only; the result lists the turns that were not reconstructed
        print(f'the turn at frame {turn.center} gives no scene: {error}', file=sys.stderr)


def load() -> None:
    """Import all that reconstruct() and solve() need, such as COLMAP."""
    import dashcalib_ros.reconstruct.build
    import dashcalib_ros.solve.joint  # noqa: F401


def solve(scenes: Sequence[Scene], config: Config,
          progress: Progress = lambda stage, done: None) -> Solution | None:
    """Adjust all scenes with one camera (paper, 3.2); None where it explains none of them.

    scenes: at least one, each as its turn was reconstructed. Those of earlier drives are not in
    the solution, nor in its misfits, where this drive's turns contradict them.
    """
    from dashcalib_ros.solve import earlier, joint
    return earlier.solve_with_earlier(
        scenes, lambda some: joint.solve(some, config, progress))


def solve_with_sensors(scenes: Sequence[Scene], config: Config, stream: SensorStream,
                       start_s: float, progress: Progress = lambda stage, done: None) -> Asked:
    """Solve as solve(), and ask the car's sensors. start_s: stamp of the drive's first image."""
    from dashcalib_ros.judge.witnesses import ask_sensors
    solution = solve(scenes, config, progress)
    progress('asking the motion sensors', 0.0)
    return ask_sensors(solution, stream, start_s, config)


def judge(solution: Solution | None, evidence: Evidence, config: Config) -> Calibration:
    """Return the calibration with its verdict; solution: None if there is none."""
    return conclude(solution, evidence, config)


def check(given: Camera, image_size: tuple[int, int], solution: Solution | None, verdict: Verdict,
          config: Config, progress: Progress = lambda stage, done: None) -> Check:
    """Say whether a given camera explains a drive of which these are the solution and verdict.

    image_size: (width, height) of the drive's pictures.
    """
    from dashcalib_ros import judge
    progress('the turns with the given camera', 0.0)
    return judge.check(given, image_size, solution, verdict, config)


def odometry(given: Camera, image_size: tuple[int, int], solution: Solution, poses: Poses,
             config: Config, progress: Progress = lambda stage, done: None) -> Odometry:
    """Return what a given camera, the drive's own and a trivial guess make of its true motion.

    Raises InputError where given is for pictures of another size, or no turn has poses.
    """
    from dashcalib_ros import judge
    if given.image_size != image_size:
        raise InputError(
            f'the calibration is for {given.image_size[0]}x{given.image_size[1]} pictures, and '
            f'those of the drive have {image_size[0]}x{image_size[1]}: poses tell nothing of it')
    progress('the turns beside the poses', 0.0)
    own = solution.camera
    small = given.resized(1 / Scale.of(image_size, config).px, own.image_size)
    cameras = {'given': small, 'ours': own, 'guess': judge.trivial_guess(own.image_size)}
    return judge.odometry(solution.scenes, cameras, poses, config)


def read(scenes: Sequence[Scene], camera: Camera, config: Config,
         progress: Progress = lambda stage, done: None) -> tuple[Reading, ...]:
    """Return what each turn says of a camera in use, and of how it is mounted.

    camera: of the scenes' pictures.
    """
    from dashcalib_ros.judge.monitor import reading_of
    progress('the turns with the camera in use', 0.0)
    return tuple(reading_of(scene, camera, config) for scene in scenes)
