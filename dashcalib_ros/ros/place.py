# SPDX-License-Identifier: Apache-2.0
"""The program that places the cameras of one car by the turns that their calibrators store."""
from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from pathlib import Path

from geometry_msgs.msg import TransformStamped
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header, String

from dashcalib_ros.camera.rotation import quaternion
from dashcalib_ros.detect.turn import is_turn
from dashcalib_ros.errors import (
    ConfigError,
    DashcalibError,
    InputError,
    OutputError,
    coded,
    one_line,
)
from dashcalib_ros.formats.rig import RIG, load_rig, rig_json
from dashcalib_ros.formats.ros import check_camera_name
from dashcalib_ros.input.motion import SensorBuffer, speeds_of
from dashcalib_ros.judge.calibration import Level
from dashcalib_ros.limits import read_file
from dashcalib_ros.report import set_aside, write_text
from dashcalib_ros.report.rig import change_lines, rig_lines
from dashcalib_ros.rig.live import rig_of_scenes
from dashcalib_ros.rig.moved import changes
from dashcalib_ros.rig.placed import LEAST_STRETCHES, PlacedCamera, RigCalibration
from dashcalib_ros.ros.car import Transforms, subscribe_sensors
from dashcalib_ros.ros.diagnostics import ERROR, OK, WARN, diagnostic
from dashcalib_ros.ros.endpoints import Answer, Endpoints
from dashcalib_ros.ros.settings import Settings
from dashcalib_ros.store.scene_file import LARGEST, SUFFIX, Origin, StoredTurn, decoded
from dashcalib_ros.workers.child import ChildWorker
from dashcalib_ros.workers.pool import Call, ScenePool

# s between two messages on /diagnostics, and between the last turn and a rig: a turn of one camera
# is stored when that of another one is still being reconstructed
PERIOD_S, SETTLED_S = 1.0, 5.0
# turns of a camera: the newest, and none that is older than the newest one by more, s
KEPT, AGE_S = 12, 3600.0


class StoredTurns:
    """The newest turns that the calibrators of cameras have stored.

    turns: by camera, by time; they stay when a calibrator has no use for them any more. origins:
    of their images. changed: when there was news, in s of time.monotonic().
    """

    # of the overrides of QoS, those that are declared later
    override_names: frozenset[str] = frozenset()

    def __init__(self, endpoints: Endpoints, folder: Path, names: tuple[str, ...],
                 apart_s: float) -> None:
        """folder: of the stores. apart_s: turns that are nearer in time are the same turn."""
        self.turns: dict[str, tuple[StoredTurn, ...]] = dict.fromkeys(names, ())
        self.origins: dict[str, Origin] = {}
        self.changed, self.listening = 0.0, False
        self._complaints, self._folder, self._apart_s = endpoints.complaints, folder, apart_s
        self._read: set[Path] = set()

    def start(self) -> None:
        """Begin to look for turns."""
        self.listening = True

    def stop(self) -> None:
        """Look no longer."""
        self.listening = False

    def look(self) -> None:
        """Read the files that are new."""
        for name in self.turns if self.listening else ():
            for path in sorted((self._folder / name).glob(f'turn-*{SUFFIX}')):
                if path not in self._read:
                    self._read.add(path)
                    self._take(name, path)

    def _take(self, name: str, path: Path) -> None:
        try:
            file = decoded(read_file(path, LARGEST))
        except (InputError, ValueError, OSError) as error:
            if path.exists():  # or its calibrator has removed it
                self._complaints.say('store', f'{path} is not a stored turn ({one_line(error)}): '
                                              f'delete it')
            return
        new = [turn for turn in file.turns if is_turn(turn.prominence)]
        kept = self.turns[name] if file.origin.fits(self.origins.get(name, file.origin)) else ()
        kept = tuple(turn for turn in kept if all(
            abs(turn.stamp_s - other.stamp_s) >= self._apart_s for other in new))
        found = sorted((*kept, *new), key=lambda turn: turn.stamp_s)[-KEPT:]
        self.turns[name] = tuple(
            turn for turn in found if found[-1].stamp_s - turn.stamp_s < AGE_S)
        self.origins[name], self.changed = file.origin, time.monotonic()

    def shared(self, name: str, base: str, since_s: float) -> int:
        """Return how many turns since a stamp the calibrators of both cameras have stored."""
        return sum(turn.stamp_s > since_s and any(
            abs(turn.stamp_s - other.stamp_s) < self._apart_s for other in self.turns[base])
            for turn in self.turns[name])


class Placing:
    """Solves a rig when there are turns that two cameras saw; what is accepted is published.

    Each later rig is of later turns, and says whether a camera was moved since. inputs: the
    stores. summary: what it does, for the log.
    """

    def __init__(self, endpoints: Endpoints, settings: Settings, camera_name: str) -> None:
        """Raises ConfigError for names that cannot be used."""
        self._endpoints, self._log, core = endpoints, endpoints.log, settings.core
        self._names = names = tuple(settings.own.cameras.split())
        if len(set(names)) < 2 or len(set(names)) < len(names):
            raise ConfigError('E-RIG-NODE-CAMERAS', "a rig needs the names of two cameras or "
                              "more: set cameras, as in -p cameras:='front left rear'")
        for name in names:
            check_camera_name(name)
        self._base, self._core = names[0], core
        stores = Path(settings.own.stores).expanduser()
        self._file = stores / RIG
        self.inputs = StoredTurns(endpoints, stores, names, core.turns.half_width)
        # what the calibrators publish
        self._levels: dict[str, Level] = dict.fromkeys(names, 'weak')
        self._frames: dict[str, str] = {}
        self._sensors = SensorBuffer()
        self._result = endpoints.latched('~/result')
        self._transforms = Transforms(endpoints)
        self._sent: dict[str, PlacedCamera] = {}
        self._diagnostics = endpoints.publisher('/diagnostics')
        # the rig in use, the one that was solved last, and what was moved since the one in use
        self.rig: RigCalibration | None = None
        self._last: RigCalibration | None = None
        self._moved = ''
        # of the turns whose rig is in use
        self._since_s = 0.0
        self._tried: object = None
        self._call: Call | None = None
        self._pool = ScenePool(
            core.replace({'workers': 1}), lambda: ChildWorker(True), _load,
            on_trouble=lambda text: endpoints.log.warning(text))
        endpoints.at_end(self._pool.close)
        for name in names:
            endpoints.subscription('NAME/calibrator/calibration', partial(self._on_lens, name),
                                   f'{name}/calibrator/calibration')
        subscribe_sensors(endpoints, settings.own, self._sensors.add)
        endpoints.service('~/reset', self._reset)
        endpoints.timer(PERIOD_S, self._tick)
        self._load_file()
        self.summary = f'placing {" ".join(names[1:])} against {names[0]} by turns in {stores}'

    def change(self, settings: Settings) -> None:
        """Do nothing: what may be changed is of the calibrators."""

    def _on_lens(self, name: str, info: CameraInfo) -> None:
        # K[0] = 0: it was withdrawn
        self._levels[name] = 'accepted' if info.k[0] > 0 else 'weak'
        self._frames[name] = info.header.frame_id

    def _reset(self) -> Answer:
        self._log.warning('reset by request: where the cameras sat is forgotten')
        self.rig, self._last, self._moved, self._tried = None, None, '', None
        self._since_s, self._call = self._newest_s(), None
        try:
            set_aside(self._file)
        except OutputError as error:
            return False, coded(error)
        return True, 'collecting; what is published stays until a rig is accepted'

    # a rig -------------------------------------------------------------------------------------

    def _newest_s(self) -> float:
        return max((turn.stamp_s for each in self.inputs.turns.values() for turn in each),
                   default=0.0)

    def _shared(self) -> dict[str, int]:
        return {name: self.inputs.shared(name, self._base, self._since_s)
                for name in self._names[1:]}

    def advance(self) -> None:
        """Take the rig that was solved, and begin another one if there are new turns."""
        if self._call is not None:
            if not self._call.done:
                return
            call, self._call = self._call, None
            try:
                self._judge(self._pool.result(call))
            except DashcalibError as error:
                self._endpoints.complaints.say('failed_calibrations', coded(error))
        turns = self.inputs.turns
        now = ({name: tuple(turn.stamp_s for turn in each) for name, each in turns.items()},
               dict(self._levels))
        if now == self._tried or time.monotonic() - self.inputs.changed < SETTLED_S or not any(
                count >= LEAST_STRETCHES and not {name, self._base} & set(self._unknown)
                for name, count in self._shared().items()):
            return
        self._tried = now
        stream = self._sensors.stream()
        self._call = self._pool.begin(
            rig_of_scenes, {name: [turn.scene for turn in each] for name, each in turns.items()},
            dict(self._levels), self._base, self._since_s, speeds_of(stream), self._core)

    def _judge(self, found: RigCalibration) -> None:
        found = replace(found, cameras={name: replace(
            camera, calibration=f'{name}/calibrator/calibration')
            for name, camera in found.cameras.items()})
        self._last = found
        for name, camera in found.cameras.items():
            self._log.info(rig_lines({name: camera})[0])
            for reason in camera.reasons:
                self._endpoints.complaints.once(coded(reason))
        change = None if self.rig is None else changes(found, self.rig)
        suspects: set[str] = set()
        if change is not None and change.answer == 'wrong':
            moves = {name: move for name, move in change.cameras.items()
                     if move.moved or move.perhaps}
            suspects = {*moves, *change.exchanged}
            first, self._moved = not self._moved, '; '.join(
                change_lines(replace(change, unknown=(), cameras=moves))[1:])
            if first:
                self._log.warning(f'{self._moved}; after ~/reset this is not an error any more')
        # what was accepted before, and was not moved, stays as it is
        known = {} if self.rig is None or self._base in suspects else {
            name: camera for name, camera in _accepted(self.rig).items() if name not in suspects}
        accepted = _accepted(found) | known
        if self._base in accepted and len(accepted) > max(len(known), 1):
            self._use(replace(found, cameras={**found.cameras, **known}))
        elif change is None or change.answer != 'right':
            return
        # the next one must be independent: it uses later turns only
        self._since_s = self._newest_s()

    def _use(self, rig: RigCalibration) -> None:
        self.rig = rig
        self._result(String(data=rig_json(rig)))
        try:
            self._file.parent.mkdir(parents=True, exist_ok=True)
            write_text(self._file, rig_json(rig))
        except (DashcalibError, OSError) as error:
            self._endpoints.complaints.say('unsaved', coded(error))

    def _load_file(self) -> None:
        """Use the rig of an earlier drive: a camera may have been moved since."""
        if not self._file.exists():
            return
        try:
            found = load_rig(self._file)
        except DashcalibError as error:
            self._log.warning(coded(error))
            return
        if (found.base, set(found.cameras)) == (self._base, set(self._names)):
            self.rig = found
            self._result(String(data=rig_json(found)))
        else:
            self._log.warning(f'{self._file} is of other cameras, or has another base: it is '
                              f'ignored, and overwritten when a rig is accepted')

    # what is said about it --------------------------------------------------------------------

    def _show_transforms(self) -> None:
        """Publish where accepted cameras sit, those that have metres, and a frame of their own."""
        top = self._frames.get(self._base, '')
        if self.rig is None or not top or not self._transforms.ready:
            return
        shown = {}
        for name, camera in self.rig.cameras.items():
            frame = self._frames.get(name, '')
            if name == self._base or camera.verdict != 'accepted' or not frame:
                continue
            why = ('it has no translation; give the speed with use_odom'
                   if camera.translation_m is None else
                   f'its images have the frame of {self._base}, {top}' if frame == top else
                   self._transforms.taken((top, frame)))
            if why:
                self._endpoints.complaints.once(f'no static transform of {name} is published: '
                                                f'{why}')
            else:
                shown[frame] = camera
        if shown and shown != self._sent:
            self._sent = shown
            self._transforms.publish([self._step(top, frame, camera)
                                      for frame, camera in shown.items()])

    def _step(self, top: str, frame: str, camera: PlacedCamera) -> TransformStamped:
        assert camera.rotation is not None and camera.translation_m is not None
        stamp = self._endpoints.node.get_clock().now().to_msg()
        message = TransformStamped(
            header=Header(stamp=stamp, frame_id=top), child_frame_id=frame)
        place, turn = message.transform.translation, message.transform.rotation
        place.x, place.y, place.z = (-camera.rotation.T @ camera.translation_m).tolist()
        turn.x, turn.y, turn.z, turn.w = quaternion(camera.rotation.T)
        return message

    def _tick(self) -> None:
        self.advance()
        self._show_transforms()
        level, state, message = self._state()
        self._diagnostics.publish(diagnostic(
            self._endpoints.node, 'camera rig', ' '.join(self._names), level, message, {
                'state': state, 'moved': self._moved,
                'rig': '; '.join(rig_lines(self.rig.cameras)) if self.rig else '',
                'turns': '; '.join(f'{name} {len(each)}' for name, each
                                   in self.inputs.turns.items()),
                'shared turns': self._shared_text, 'reasons': '; '.join(self._reasons),
                'lenses not accepted': ' '.join(self._unknown),
                'file': self._file, **self._endpoints.complaints.counts}))

    def _state(self) -> tuple[bytes, str, str]:
        if not self.inputs.listening:
            return WARN, 'inactive', 'inactive: the node looks for no turns until it is activated'
        if self._moved:
            return ERROR, 'moved', self._moved
        missing = [name for name in self._names if self.rig is None
                   or self.rig.cameras[name].verdict != 'accepted']
        if not missing:
            return OK, 'placed', f'placed: {" ".join(self._names)}'
        return WARN, 'collecting' if self._call is None else 'placing', '; '.join((
            f'not placed yet: {" ".join(missing)}; turns that {self._base} saw, too: '
            f'{self._shared_text}, {LEAST_STRETCHES} are needed',
            *([f'lenses not accepted: {" ".join(self._unknown)}'] if self._unknown else ()),
            *self._reasons[:1]))

    @property
    def _unknown(self) -> list[str]:
        """Return the cameras whose calibrators have accepted no lens."""
        return [name for name, level in self._levels.items() if level != 'accepted']

    @property
    def _shared_text(self) -> str:
        return ', '.join(f'{name} {count}' for name, count in self._shared().items())

    @property
    def _reasons(self) -> list[str]:
        return [str(reason) for camera in self._last.cameras.values()
                for reason in camera.reasons] if self._last else []


def _accepted(rig: RigCalibration) -> dict[str, PlacedCamera]:
    return {name: camera for name, camera in rig.cameras.items() if camera.verdict == 'accepted'}


def _load() -> None:
    import dashcalib_ros.rig.live  # noqa: F401
