"""What the turns of a drive say of other cameras than their own: given ones, one in use."""
from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from dashcalib_ros import judge
from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import Camera
from dashcalib_ros.detect import TurnId
from dashcalib_ros.errors import InputError
from dashcalib_ros.input.scale import Scale
from dashcalib_ros.input.source import by
from dashcalib_ros.judge import Calibration, Check, Monitor, Odometry, Poses, Reading
from dashcalib_ros.judge.check import CALIBRATION
from dashcalib_ros.judge.monitor import readings_of
from dashcalib_ros.pipeline import Calibrator
from dashcalib_ros.workers.worker import Progress


class Questions:
    """Asks the turns of a calibrator, in its workers; for the calibrator's thread.

    All cameras are of the full-size pictures.
    """

    def __init__(self, calibrator: Calibrator) -> None:
        self._asked = calibrator
        # what turns say of the camera that watch() was asked about last, resized
        self._watched: Camera | None = None
        self._read: dict[TurnId, Reading] = {}

    def check(self, given: Camera, calibration: Calibration, progress: Progress | None = None,
              name: str = CALIBRATION) -> Check:
        """Say whether a given camera explains the drive.

        calibration: what the last calibrate() returned. progress: as for calibrate(). name: of
        the given camera's file, for the command that a message offers.
        """
        config = self._asked.scenes.config
        found: Check = self._run('the turns with the given camera', progress, judge.check, given,
                                 calibration.image_size, self._asked.solution,
                                 calibration.verdict, config, name)
        lines = self._asked.detection.lines()
        return judge.with_lines(found, given, lines, calibration.image_size, config)

    def odometry(self, given: Camera, calibration: Calibration, poses: Poses,
                 progress: Progress | None = None) -> Odometry | None:
        """Compare the motion that cameras find in the turns with true poses.

        The cameras: given, the drive's own, and a trivial guess. given, calibration: as for
        check(). Returns None where the drive has no camera of its own. Raises InputError where
        given is for pictures of another size, or no turn has poses.
        """
        solution, size = self._asked.solution, calibration.image_size
        if solution is None:
            return None
        if given.image_size != size:
            raise InputError(
                'E-CALIBRATION-SIZE',
                f'the calibration is for {by(given.image_size)} pictures, and those of the drive '
                f'have {by(size)}, so that poses cannot test it; resize it with dashcalib export '
                f'--size')
        own, config = solution.camera, self._asked.scenes.config
        cameras = {'given': given.resized(1 / Scale.of(size, config).px, own.image_size),
                   'ours': own, 'guess': judge.trivial_guess(own.image_size)}
        found: Odometry = self._run('the turns beside the poses', progress, judge.odometry,
                                    solution.scenes, cameras, poses, config)
        return found

    def watch(self, camera: Camera, sigma: Mapping[str, float] | None = None,
              progress: Progress | None = None) -> Monitor:
        """Return whether the turns so far show that a camera in use has changed.

        sigma: of its parameters; None for a camera that is not known to have fitted any turns
        before these: then only turns behind one that it explains can show a change. Turns that
        were read with the same camera before are not read again. progress: as for calibrate().
        Raises InputError where the camera is for pictures of another size.
        """
        small, scale = self._small(camera), self._asked.detection.scale
        scenes, config = self._asked.scenes.all_scenes(), self._asked.scenes.config
        if self._watched != small:
            self._watched, self._read = small, {}
        new = [scene for turn, scene in scenes.items() if turn not in self._read]
        if new:
            readings: tuple[Reading, ...] = self._run(
                'the turns with the camera in use', progress, readings_of, new, small, config)
            self._read |= {reading.turn: reading for reading in readings}
        units = dict(zip(small.names(), small.units(scale.px).tolist(), strict=True))
        scaled = None if sigma is None else {
            name: value / units.get(name, 1.0) for name, value in sigma.items()}
        # a stored turn that was driven again counts once
        return judge.watch((reading for turn, reading in sorted(self._read.items())
                      if turn.of_this_drive or turn in scenes), small, scaled, config.monitor)

    def moved(self, camera: Camera, newest: int) -> tuple[float, Floats] | None:
        """Return when and by how much the camera was moved on the car; None where it was not.

        That is s before the newest image, and (2,) degrees to the left and upwards. newest: pairs
        of images of straight driving that are asked. Raises InputError as watch() does.
        """
        straights = self._asked.detection.straights(newest)
        found = self._run('straight stretches with the camera in use', None, judge.moved,
                          straights, self._small(camera))
        return found and (float(straights.stamps_s[-1] - found[0]), found[1])

    def _small(self, camera: Camera) -> Camera:
        """Return a camera of the resized pictures."""
        size, scale = self._asked.detection.size, self._asked.detection.scale
        if camera.image_size != size:
            raise InputError('E-CALIBRATION-SIZE',
                             f'the camera in use is for pictures of another size: '
                             f'{by(camera.image_size)}; resize it with dashcalib export --size')
        return camera.resized(1 / scale.px, scale.size(size))

    def _run(self, stage: str, progress: Progress | None, function: Callable[..., Any],
             *arguments: Any) -> Any:
        if progress is not None:
            progress(stage, 0.0)
        return self._asked.workers.run(function, *arguments)
