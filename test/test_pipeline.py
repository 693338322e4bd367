# SPDX-License-Identifier: Apache-2.0
"""The whole story on a rendered drive: the right lens, the same every time, or a refusal."""
from __future__ import annotations

import contextlib
import dataclasses
import gc
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
import types
import weakref
from collections.abc import Iterable, Iterator
from dataclasses import replace

import child_tasks
import cv2
import numpy as np
import pytest
from refused import refused
from shared_drive import LENS, ONE_TURN, OTHER_TURN, QUICK, SharedDrive
from synthetic import synthetic_turn

from dashcalib_ros import judge
from dashcalib_ros.camera import Radial
from dashcalib_ros.config import Config
from dashcalib_ros.demo import Drive, DriveSpec, Lens
from dashcalib_ros.detect import Turn, TurnId
from dashcalib_ros.detect.detection import Detection
from dashcalib_ros.detect.one_camera import OtherCamera
from dashcalib_ros.errors import InputError, WorkerError
from dashcalib_ros.input import Frame
from dashcalib_ros.input.motion import Samples, SensorStream
from dashcalib_ros.judge.agreement import OTHER_CAMERA, STOOD
from dashcalib_ros.judge.conclude import conclude, evidence_of_detection
from dashcalib_ros.pipeline import Calibrator
from dashcalib_ros.reconstruct import reconstruct
from dashcalib_ros.reconstruct.scene import Scene
from dashcalib_ros.report import Calibration
from dashcalib_ros.report.turns import LEFT
from dashcalib_ros.selection import SceneSelection
from dashcalib_ros.session import calibrate
from dashcalib_ros.solve import solve
from dashcalib_ros.store.turn_store import Origin, StoredTurn, TurnStore
from dashcalib_ros.workers.worker import THREAD_VARIABLES

TRUE = Radial((640, 360), *LENS.truth.values())
LONGER = TRUE.resized(1.03, TRUE.image_size)
LIMIT_S = 300.0


@pytest.fixture(scope='session')
def drive(shared_drive) -> SharedDrive:
    return shared_drive


@pytest.fixture(scope='session')
def frames(drive) -> list[Frame]:
    return list(drive.frames())


@contextlib.contextmanager
def limited(calibrator: Calibrator) -> Iterator[Calibrator]:
    """Close a calibrator that takes far too long: what waits for it then raises."""
    guard = threading.Timer(LIMIT_S, calibrator.close)
    guard.daemon = True
    guard.start()
    try:
        with calibrator:
            yield calibrator
    finally:
        guard.cancel()


def calibrated(frames: Iterable[Frame], config: Config = QUICK, **options) -> Calibration:
    with limited(Calibrator(config, **options)) as calibrator:
        for frame in frames:
            calibrator.push(frame)
        return calibrator.calibrate()


@pytest.fixture(scope='session')
def result(shared_calibration) -> Calibration:
    return shared_calibration


def same(first: Calibration, second: Calibration) -> bool:
    """Tell whether two results are equal to the last bit (but for the time they took)."""
    assert first.intrinsics is not None
    return (first.intrinsics, first.sigma, first.verdict, first.turns, first.details) == (
        second.intrinsics, second.sigma, second.verdict, second.turns, second.details)


# a drive with two turns

def test_it_finds_the_lens(drive, frames, result):
    assert result.verdict.level != 'refused', result.verdict
    truth, found, sigma = drive.truth, result.intrinsics, result.sigma
    allowed = {'fx': 0.02 * truth['fx'], 'fy': 0.02 * truth['fy'], 'cx': 6.0, 'cy': 6.0,
               'k1': 0.02, 'k2': 0.02}
    for name, tolerance in allowed.items():
        off = abs(found[name] - truth[name])
        assert off < tolerance, name
        assert off < 4 * sigma[name], name
    assert result.image_size == (640, 360) and result.frames == len(frames)
    assert 0.05 < result.reprojection_error_px < 0.8


def test_it_tells_of_its_turns(drive, result):
    assert len(result.turns) == 2 and all(turn.used for turn in result.turns)
    for turn, center, angle in zip(result.turns, drive.turn_centers, (85.0, 80.0), strict=True):
        assert abs(turn.center - center) <= 5
        assert turn.first <= turn.center <= turn.last
        assert turn.yaw_deg == pytest.approx(angle, abs=8.0)
        assert 0.8 * turn.images < turn.registered <= turn.images <= 20
    assert set(result.timing) == {'detect', 'calibrate', 'total'}
    assert result.magnitudes.shape[1] == 2 and len(result.magnitudes) > 50
    assert result.versions['engine'] == Config().reconstruct.used
    assert result.versions['numpy'] != 'not installed'
    # for the report: each turn's picture, of a keyframe
    for turn in result.turns:
        assert turn.unused_because is None
        picture = result.material.pictures[turn.id]
        assert picture.frame in result.material.scenes[turn.id].tracks.frames
        assert abs(picture.frame - turn.center) < 6 and picture.image.shape == (360, 640)


def test_the_pictures_of_a_turn_that_waits_are_in_a_file(frames):
    given = {frame.index: frame.image for frame in frames}
    with limited(Calibrator(QUICK)) as calibrator:
        for frame in frames:
            calibrator.push(frame)
            if waiting := calibrator.detection.turns():
                break
    shown = waiting[0].frames
    assert len(shown) > 10
    for frame in shown:
        assert np.array_equal(frame.image, given[frame.index])
        assert given[frame.index].flags.writeable and not frame.image.flags.writeable


@pytest.mark.thorough
def test_a_turn_during_which_the_car_stood_is_none(frames, result):
    moving, phantom = result.turns
    stamps_s = np.array([frame.stamp_ns for frame in frames]) / 1e9
    speed = np.full((len(frames), 1), 8.0)
    speed[phantom.first:phantom.last + 1] = 0.05
    with limited(Calibrator(QUICK)) as calibrator:
        calibrator.sense(SensorStream(speed=Samples(stamps_s - stamps_s[0], speed)))
        for frame in frames:
            calibrator.push(frame)
        found = calibrator.calibrate()
        # the same pictures, with a car that never moved there
        calibrator.sense(SensorStream(speed=Samples(
            np.append(stamps_s - stamps_s[0], 1e3), np.append(0 * speed, [[8.0]], axis=0))))
        none = calibrator.calibrate(final=False)
    assert {turn.id: turn.unused_because for turn in found.turns} == {
        moving.id: None, phantom.id: STOOD}
    assert none.verdict.codes[0] == 'E-CAR-STOOD'
    assert found.verdict.level == 'weak'


def test_two_threads_and_a_child_that_is_killed_change_nothing(frames, result):
    killed = []

    def assassin(calibrator: Calibrator, ended: threading.Event) -> None:
        while not killed and not ended.wait(0.05):
            for pid in calibrator.workers.pids():
                time.sleep(0.5)  # in the middle of something
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
                    killed.append(pid)

    ended = threading.Event()
    with limited(Calibrator(QUICK.replace({'workers': 2}))) as calibrator:
        thread = threading.Thread(target=assassin, args=(calibrator, ended), daemon=True)
        thread.start()
        try:
            for frame in frames:
                calibrator.push(frame)
            again = calibrator.calibrate()
        finally:
            ended.set()
            thread.join(10)
    assert killed and same(result, again)


@pytest.mark.thorough
def test_a_live_calibrator_gives_the_same_even_if_asked_on_the_way_with_a_turn_lost(
        frames, result):
    stages: dict[str, float] = {}
    told: list[str] = []
    with limited(Calibrator(QUICK, live=True, on_trouble=told.append)) as calibrator:
        for frame in frames[:ONE_TURN]:
            status = calibrator.push(frame)
        assert status.frames == ONE_TURN and status.turns == 1
        end = time.monotonic() + LIMIT_S
        # a child that only loads is not missed
        while not told and time.monotonic() < end:
            for pid in calibrator.workers.pids():
                os.kill(pid, signal.SIGKILL)
            time.sleep(0.5)
        # the turn is tried again, and nobody waits for it
        while calibrator.status().built < 1 and time.monotonic() < end:
            time.sleep(0.1)
        early = calibrator.calibrate(stages.__setitem__, final=False)
        assert calibrator.status().built == 1
        assert calibrator.status().reconstructed == calibrator.status().ready
        assert calibrator.status().yaw_deg == pytest.approx(85.0, abs=8.0)
        assert calibrator.status().ways == (LEFT,)
        for frame in frames[ONE_TURN:]:
            calibrator.push(frame)
            # whatever waits, waits in the pool, whose queue has an end
            assert not any(turn.frames for turn in calibrator.detection.turns())
        late = calibrator.calibrate()
        asked = [judge.check(lens, late.image_size, calibrator.solution, late.verdict, QUICK,
                             calibrator.detection.lines()) for lens in (TRUE, LONGER)]
        pids = calibrator.workers.pids()
        assert pids and all(os.getpriority(os.PRIO_PROCESS, pid) >= 10 for pid in pids)
    assert len(told) == 1 and 'exit code -9' in told[0] and 'is tried again' in told[0]
    assert early.frames == ONE_TURN and early.verdict.level in ('weak', 'refused')
    assert 'E-FEW-TURNS' in early.verdict.codes
    assert 'reconstructing turns' in stages and len(stages) >= 4
    assert all(0.0 <= done <= 1.0 for done in stages.values())
    assert same(result, late)
    assert [each.answer for each in asked] == ['right', 'wrong']
    assert asked[1].loss > abs(asked[0].loss)
    # the node writes no report
    assert late.material is None
    # no process is left behind
    assert not any(os.path.exists(f'/proc/{pid}') for pid in pids)  # noqa: PTH110


INLINE = """
import pickle, sys
from dashcalib_ros.pipeline import Calibrator
from dashcalib_ros.session import calibrate
frames, config = pickle.load(sys.stdin.buffer)
with Calibrator(config, inline=True) as calibrator:
    for frame in frames:
        calibrator.push(frame)
    result = calibrator.calibrate()
    assert calibrator.workers.pids() == []
sys.stdout.buffer.write(pickle.dumps(result))
"""


@pytest.mark.thorough
def test_inline_and_in_child_processes_it_is_the_same(frames, result):
    # a process of its own: numpy reads these when it is loaded
    environment = {**os.environ, **dict.fromkeys(THREAD_VARIABLES, '1')}
    done = subprocess.run([sys.executable, '-c', INLINE], input=pickle.dumps((frames, QUICK)),
                          env=environment, capture_output=True, timeout=LIMIT_S, check=True)
    inline: Calibration = pickle.loads(done.stdout)
    assert same(result, inline) and result.misfits == inline.misfits
    assert result.reprojection_error_px == inline.reprojection_error_px


@pytest.mark.thorough
def test_the_stages_by_hand_give_what_the_calibrator_gives(frames, result):
    detection, valid = Detection(QUICK), {}
    for frame in frames:
        detection.push(frame)
        # the mask is that of when a turn was found
        valid = {turn.id: detection.valid() for turn in detection.turns()} | valid
    detection.finish()
    scenes = [reconstruct(turn, QUICK, valid[turn.id]) for turn in detection.turns()]
    solution = solve([scene for scene in scenes if scene is not None], QUICK)
    evidence = evidence_of_detection(detection, scenes)
    by_hand = conclude(solution, evidence, QUICK)
    assert by_hand.verdict.level == result.verdict.level
    # where numpy has more than one thread, sums come in another order
    np.testing.assert_allclose(by_hand.camera.params, result.camera.params, rtol=1e-6)
    assert [turn.center for turn in by_hand.turns] == [turn.center for turn in result.turns]
    # what is known beside them costs no turn, and no verdict
    sigma = by_hand.sigma['fx']
    fx = by_hand.camera.fx + sigma
    informed = conclude(solution, evidence, QUICK.replace({
        'known.fx': f'{fx:.2f}±{sigma:.2f}'}))
    assert informed.verdict.level == by_hand.verdict.level and informed.known[0].used
    assert by_hand.camera.fx < informed.camera.fx < fx
    assert informed.turns_used == by_hand.turns_used == 2


def test_what_fails_beside_the_solution_costs_itself_only(frames, monkeypatch):
    def broken(*arguments):
        raise IndexError('list index out of range')
    with limited(Calibrator(QUICK)) as calibrator:
        for frame in frames[:ONE_TURN]:
            calibrator.push(frame)
        sound = calibrator.calibrate()
        calibrator.sense(SensorStream(rate=Samples(np.arange(9.0), np.zeros((9, 3)))))
        for part in ('detect.detection.Detection.lines', 'detect.detection.Detection.straights',
                     'judge.agreement.turns_that_stood'):
            monkeypatch.setattr(f'dashcalib_ros.{part}', broken)
        # in the child it raises
        monkeypatch.setattr('dashcalib_ros.pipeline.compare_sensors', child_tasks.fail)
        found = calibrator.calibrate()
    codes = [each.code for each in found.warnings[len(sound.warnings):]]
    assert codes == ['E-PART-MISSING'] * 4 and found.intrinsics == sound.intrinsics
    assert found.mount is None and found.straight_lines is None


def test_close_ends_a_calibration_that_runs(frames):
    calibrator = Calibrator(QUICK)
    outcome: list[object] = []

    def calibrate() -> None:
        try:
            outcome.append(calibrator.calibrate())
        except Exception as error:
            outcome.append(error)

    with limited(calibrator):
        for frame in frames[:ONE_TURN]:
            calibrator.push(frame)
        thread = threading.Thread(target=calibrate, daemon=True)
        thread.start()
        time.sleep(0.3)
        calibrator.close()
        thread.join(20)
        assert not thread.is_alive()
    assert len(outcome) == 1 and isinstance(outcome[0], WorkerError)
    assert calibrator.workers.pids() == []


def test_close_frees_the_images_at_once(frames):
    """A calibrator refers to itself: Python would free it some time, and a drive has several."""
    gc.disable()
    try:
        with Calibrator(QUICK, live=True) as calibrator:
            held = []
            for frame in frames[:ONE_TURN]:
                image = frame.image.copy()
                held.append(weakref.ref(image))
                calibrator.push(replace(frame, image=image))
            del frame, image
            assert sum(ref() is not None for ref in held) > 10
        assert calibrator.detection.turns()
        # the newest images stay with what tracks points
        assert sum(ref() is not None for ref in held) <= 3
    finally:
        gc.enable()


def test_more_turns_than_the_bank_would_hold():
    config = QUICK.replace({'turns.wanted': 12, 'turns.capacity': 3})
    with Calibrator(config) as calibrator:
        assert calibrator.detection._turns.config.capacity == 12
    # what the user has set is what is written down
    assert config.turns.capacity == 3
    with Calibrator(QUICK) as calibrator:
        assert calibrator.detection._turns.config.capacity == QUICK.turns.capacity


# drives that add up

def later(frames: Iterable[Frame], seconds: float) -> list[Frame]:
    return [replace(frame, index=frame.index - frames[0].index,
                    stamp_ns=frame.stamp_ns + round(seconds * 1e9)) for frame in frames]


def garbage(center: int = 0) -> Scene:
    """Return a scene of the drive's camera that no lens explains."""
    lens = Radial((640, 360), 390.0, 390.0, 325.0, 175.0, -0.2)
    scene = synthetic_turn(lens, keyframes=12, tracks=120).scene(lens, center)
    xy = np.random.default_rng(0).uniform((0, 0), (640, 360), scene.tracks.xy.shape)
    xy[~scene.tracks.seen] = np.nan
    return replace(scene, tracks=replace(scene.tracks, xy=xy))


@pytest.mark.thorough
def test_two_short_drives_add_up(drive, frames, tmp_path):
    folder = tmp_path / 'turns'
    config = QUICK.replace({'turns.store': str(folder)})
    store = TurnStore(str(folder), 10, 3.0, pytest.fail)
    store.load(Origin((640, 360)))
    store.mirror({TurnId.at(0): StoredTurn(garbage(), 5.0, 0.9)})
    assert len(list(folder.iterdir())) == 1

    first = calibrated(frames[:ONE_TURN], config)
    assert first.verdict.level == 'weak' and first.turns_used == 1
    assert 'E-FEW-TURNS' in first.verdict.codes
    # the joint adjustment rejects what does not fit, and it is gone from the disk
    assert [turn.used for turn in first.stored_turns] == [False]
    assert len(list(folder.iterdir())) == 1

    half = later(frames[OTHER_TURN:], 86400.0)
    second = calibrated(half, config)
    assert len(second.turns) == len(second.stored_turns) == 1 and second.turns_used == 2
    assert 'E-FEW-TURNS' not in second.verdict.codes
    # the input's frames are counted by what is of this input alone
    assert second.frames == len(half) and second.turns[0].first >= 0
    stored = second.stored_turns[0]
    assert second.used_turns == {second.turns[0].id, stored.id}
    assert stored.used and stored.yaw_deg == pytest.approx(85.0, abs=8.0)
    assert stored.stamp_s == pytest.approx(first.turns[0].stamp_s)
    assert abs(second.intrinsics['fx'] / drive.truth['fx'] - 1) < 0.02
    assert len(list(folder.iterdir())) == 2

    # the same drive again is no new evidence
    again = calibrated(half, config)
    assert same(second, again) and again.stored_turns == second.stored_turns
    assert len(list(folder.iterdir())) == 2


def test_turns_of_two_cameras_are_not_stored(frames, tmp_path, monkeypatch):
    monkeypatch.setattr(Detection, 'other_camera', OtherCamera(10, 20, 'another view'))
    found = calibrated(frames[:ONE_TURN], QUICK.replace({'turns.store': str(tmp_path)}))
    assert found.verdict.level == 'refused' and found.turns[0].used
    assert found.verdict.codes[0] == 'E-TWO-CAMERAS' and not list(tmp_path.iterdir())


@pytest.mark.thorough
def test_a_turn_that_is_played_in_a_loop_counts_once(drive, frames):
    around = [frame.image for frame in frames[drive.turn_centers[0] - 21:
                                              drive.turn_centers[0] + 21]]
    # the tracks of both must be near each other, so there are as many as users have
    enough = {name: value for name, value in Config().flat().items()
              if name in ('tracks.points', 'scene.tracks', 'scene.keyframes')}
    with limited(Calibrator(QUICK.replace({**enough, 'turns.wanted': 3}))) as calibrator:
        for n, image in enumerate(2 * around):
            calibrator.push(Frame(n, drive.stamp_ns(n), image))
        looped = calibrator.calibrate()
    assert looped.verdict.level != 'accepted' and looped.turns_used == 1
    assert 'E-FEW-TURNS' in looped.verdict.codes
    assert 'E-TURN-REPEATED' in [each.code for each in looped.warnings]
    reasons = [turn.unused_because for turn in looped.turns if not turn.used]
    assert any('shows the same pictures as the turn at frame' in text for text in reasons)


@pytest.mark.thorough
def test_a_stored_turn_of_another_camera_is_told_and_stays(drive, frames, tmp_path):
    config = QUICK.replace({'turns.store': str(tmp_path)})
    lens = Radial((640, 360), 460.0, 460.0, 319.5, 179.5, -0.1)
    store = TurnStore(str(tmp_path), 10, 3.0, pytest.fail)
    store.load(Origin((640, 360)))
    stranger = StoredTurn(synthetic_turn(lens, tracks=150).scene(lens), 5.0, 0.001)
    store.mirror({TurnId.at(0): stranger})
    result = calibrated(frames[:ONE_TURN], config)
    assert result.verdict.level != 'accepted' and result.turns[0].used, result.verdict
    # the turn of this drive is taken alone, and the other one does not move its lens
    [other] = result.stored_turns
    assert not other.used and other.unused_because == OTHER_CAMERA
    assert set(result.misfits) == {result.turns[0].id} and result.turns_used == 1
    assert abs(result.intrinsics['fx'] / drive.truth['fx'] - 1) < 0.02
    assert len(list(tmp_path.iterdir())) == 2


def test_stored_turns_of_another_size_are_left_out_and_told(tmp_path):
    config = QUICK.replace({'turns.store': str(tmp_path)})
    store = TurnStore(str(tmp_path), 10, 3.0, pytest.fail)
    store.load(Origin((640, 360)))
    store.mirror({TurnId.at(0): StoredTurn(garbage(), 5.0, 0.9)})
    told: list[str] = []
    with Calibrator(config, warn=told.append) as calibrator:
        assert calibrator.push(pictures(1, 320, 180)[0]).turns == 0
        result = calibrator.calibrate()
    assert len(told) == 1 and result.warnings == tuple(told) and '640x360' in str(told[0])
    assert result.warnings[0].code == 'E-STORE-OTHER-CAMERA'
    assert result.stored_turns == () and len(list(tmp_path.iterdir())) == 1
    # of this size they count as turns, until they are forgotten
    with Calibrator(config, live=True) as calibrator:
        status = calibrator.push(pictures(1, 640, 360)[0])
        assert (status.turns, status.built, status.stored) == (1, 0, 1)
        assert status.reconstructed == (TurnId.stored(0),)
        # but alone they give nothing: they may be another camera's
        result = calibrator.calibrate()
        assert result.verdict.level == 'refused'
        assert 'could agree' in result.stored_turns[0].unused_because
        calibrator.scenes.forget_stored()
        assert calibrator.status().turns == 0 and list(tmp_path.iterdir()) == []


def test_a_camera_in_use_is_compared_with_stored_turns(tmp_path):
    store = TurnStore(str(tmp_path), 10, 3.0, pytest.fail)
    store.load(Origin((640, 360)))
    lens = Radial((640, 360), 390.0, 390.0, 319.5, 179.5, -0.2, 0.03)
    scenes = [synthetic_turn(lens, keyframes=10, tracks=100, world=n).scene(lens, n)
              for n in range(2)]
    store.mirror({scene.turn: StoredTurn(scene, 50.0 * n, 0.8 - n / 10)
                          for n, scene in enumerate(scenes)})
    sigma = dict.fromkeys(lens.names(), 0.1)
    with Calibrator(QUICK.replace({'turns.store': str(tmp_path)})) as calibrator:
        calibrator.push(pictures(1, 640, 360)[0])
        # a single image shows no straight road
        assert judge.moved(calibrator.detection.straights(100), lens) is None
        with refused(InputError, 'E-CALIBRATION-SIZE', '320x180'):
            calibrator.detection.resized(replace(lens, image_size=(320, 180)))

        def watched(camera):
            readings = calibrator.workers.run(
                judge.readings_of, calibrator.scenes.reconstructed(), camera, QUICK)
            return judge.watch(readings, camera, sigma, QUICK.monitor)
        assert watched(lens).lens is None
        change, = watched(replace(lens, fx=10 * lens.fx)).changes
        assert change.kind == 'lens' and change.since == TurnId.stored(0)
        # of other turns than these it knows nothing
        assert not watched(lens).agrees
        calibrator.scenes.forget_stored({TurnId.stored(1)})
        assert calibrator.status().reconstructed == (TurnId.stored(1),)
        assert len(watched(lens).readings) == len(list(tmp_path.iterdir())) == 1


def standing(on: str) -> Iterator[Frame]:
    """Yield what a car that stands sees: the shore turns about a ferry, a lift passes a wall."""
    wide = Lens.of(1280, 720, 115.0, 0.0, 0.0)
    far = Drive(wide, DriveSpec(kind='parked', duration_s=1.0, noise=0.0, vibration_deg=0.0,
                                seed=5)).frame(0).image
    inner, outer = (np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
                    for lens in (Lens.of(640, 360, 80.0, 0.0, 0.0), wide))
    rng = np.random.default_rng(0)
    for n in range(180):
        if on == 'ferry':
            x, y, z = np.radians([1.5 * np.sin(0.13 * n), 8 * np.sin(n / 30),
                                  2 * np.sin(0.09 * n + 1)])
            turned = np.eye(3)
            for axis in ((x, 0, 0), (0, y, 0), (0, 0, z)):
                turned = turned @ cv2.Rodrigues(np.array(axis))[0]
            image = cv2.warpPerspective(far, inner @ turned @ np.linalg.inv(outer), (640, 360),
                                        borderMode=cv2.BORDER_REFLECT)
            image[260:] = far[500:600, 300:940]  # the deck
        else:
            image = np.roll(far, round(60 * np.sin(n / 20)), axis=0)[180:540, 300:940]
        image = image + rng.normal(0, 1.5, image.shape)
        yield Frame(n, n * 10**8, np.clip(image, 0, 255).astype(np.uint8))


@pytest.mark.parametrize('on', ['ferry', pytest.param('lift', marks=pytest.mark.thorough)])
def test_a_car_that_stands_while_pictures_move_is_refused(on):
    with limited(Calibrator(QUICK.replace({'known.stabiliser': 'no'}))) as calibrator:
        for frame in standing(on):
            calibrator.push(frame)
        found = calibrator.calibrate()
    assert found.verdict.level == 'refused' and found.camera is None


@pytest.mark.thorough
def test_a_drive_backwards_shows_the_same_lens(frames, result):
    with limited(Calibrator(QUICK)) as calibrator:
        for frame, back in zip(frames, frames[::-1], strict=True):
            calibrator.push(replace(frame, image=back.image))
        found = calibrator.calibrate()
    assert found.verdict.level == result.verdict.level and len(found.turns) == len(result.turns)
    assert abs(found.camera.fx - LENS.fx) < 3 * found.sigma['fx']


@pytest.mark.parametrize(('own', 'more', 'used'), [
    (0, 0, ''), (1, 0, 'oss'), (2, 0, 'oos'), (4, 0, 'ooo'), (4, 1, 'oooo'), (2, 1, 'oos')])
def test_turns_of_this_drive_come_before_more_prominent_ones_of_earlier_drives(own, more, used):
    scene = garbage()
    turns = tuple(types.SimpleNamespace(id=TurnId.at(n), prominence=0.01) for n in range(own))
    selection = SceneSelection(QUICK.replace({'turns.wanted': 3}),
                               types.SimpleNamespace(turns=lambda: turns, stretches=tuple),
                               types.SimpleNamespace(
                                   scenes=lambda: {turn.id: replace(scene, turn=turn.id)
                                                   for turn in turns}))
    selection.want(3, more)
    selection._store.turns = {key: StoredTurn(replace(scene, turn=key), 0.0, 0.9)
                             for key in map(TurnId.stored, range(5))}
    chosen = [scene.turn for scene in selection.chosen()]
    assert ''.join('o' if turn.of_this_drive else 's' for turn in chosen) == used


def live_selection(turns, stretches, busy=()):
    """Return a live drive's selection."""
    return SceneSelection(
        QUICK.replace({'turns.wanted': 5}),
        types.SimpleNamespace(
            turns=lambda: tuple(Turn(n, n, n, float(n), 0.1) for n in range(turns)),
            stretches=lambda: stretches, valid=lambda: None),
        types.SimpleNamespace(scenes=dict, unbuilt=lambda: frozenset(busy)), True)


@pytest.mark.parametrize(('turns', 'busy', 'asked', 'begun'), [
    (0, (), True, [50]), (3, (), True, [50]), (4, (), True, []), (0, (TurnId.at(1),), True, []),
    (0, (), False, [])])
def test_a_live_drive_takes_a_stretch_while_workers_idle_and_turns_are_few(
        frames, turns, busy, asked, begun):
    stretches = (Turn(20, 0, 40, 2.0, 0.002), Turn(50, 41, 80, 5.0, 0.001, tuple(frames[:2])))
    selection = live_selection(turns, stretches, busy)
    selection.want(5, 0, asked)
    assert [turn.center for turn, _ in selection.stretch_plan().build] == begun
    assert selection.few == (asked and turns < 4)


def test_stretches_of_earlier_drives_fill_up_and_are_no_turns():
    scene, own = garbage(), Turn(20, 0, 40, 2.0, 0.002)
    selection = SceneSelection(
        QUICK.replace({'turns.wanted': 3, 'turns.stretches': 3}),
        types.SimpleNamespace(turns=tuple, stretches=lambda: (own,)),
        types.SimpleNamespace(scenes=lambda: {own.id: replace(scene, turn=own.id)}))
    selection._store.turns = {TurnId.stored(n): StoredTurn(
        replace(scene, turn=TurnId.stored(n)), 0.0, prominence)
        for n, prominence in enumerate((0.001, 0.9, 0.002, 0.0005))}
    chosen = selection.chosen()
    assert [scene.turn for scene in chosen] == [
        TurnId.stored(1), own.id, TurnId.stored(2), TurnId.stored(0)]
    assert [scene.turn for scene in selection.turns_of(chosen)] == [TurnId.stored(1)]
    selection._store.turns |= {TurnId.stored(n): StoredTurn(scene, 0.0, 0.9) for n in (5, 6)}
    # enough of other drives' turns; this one's stretch stays, which they must agree with
    assert [str(turn.turn) for turn in selection.chosen()][3:] == [str(own.id)]


@pytest.mark.parametrize(('more_to_come', 'begun'), [(True, [0]), (False, [0, 1, 2, 3])])
def test_the_least_turns_wait_for_better_ones(frames, more_to_come, begun):
    turns = tuple(Turn(n, n, n, float(n), 0.1 - 0.01 * n, tuple(frames[:2])) for n in range(4))
    selection = SceneSelection(
        QUICK.replace({'turns.wanted': 5}),
        types.SimpleNamespace(turns=lambda: turns, stretches=tuple, valid=lambda: None),
        types.SimpleNamespace(scenes=dict))
    plan = selection.plan(more_to_come)
    assert [turn.center for turn, _ in plan.build] == begun
    assert {turn.center for turn in plan.set_aside} == {0, 1, 2, 3} - {*begun}
    # once each
    assert selection.plan(more_to_come).set_aside == ()


def test_turns_that_are_rejected_leave_the_store(tmp_path):
    store = TurnStore(str(tmp_path), 10, 3.0, pytest.fail)
    store.load(Origin((640, 360)))
    lens = Radial((640, 360), 390.0, 390.0, 325.0, 175.0, -0.2)
    other = synthetic_turn(lens, keyframes=12, tracks=120, world=1).scene(lens, 9)
    store.mirror({TurnId.at(0): StoredTurn(garbage(), 5.0, 0.9),
                          TurnId.at(9): StoredTurn(other, 50.0, 0.8)})
    with Calibrator(QUICK.replace({'turns.store': str(tmp_path)}), live=True) as calibrator:
        first, second = calibrator.push(pictures(1, 640, 360)[0]).reconstructed
        calibrator.scenes.exclude({first: 'moved'})
        assert calibrator.status().reconstructed == (second,) and calibrator.status().turns == 1
        assert len(list(tmp_path.iterdir())) == 1
        calibrator.scenes.exclude(dict.fromkeys((first, TurnId.at(77)), 'moved'))  # none there
        assert calibrator.status().reconstructed == (second,)


# drives that cannot calibrate

def pictures(count: int, width: int, height: int, seed: int | None = None) -> list[Frame]:
    rng = np.random.default_rng(seed)
    return [Frame(n, n * 10**8, np.zeros((height, width), np.uint8) if seed is None
                  else rng.integers(0, 256, (height, width), np.uint8)) for n in range(count)]


def refusal(frames: Iterable[Frame]) -> tuple[str, ...]:
    calibration = calibrated(frames)
    assert calibration.verdict.level == 'refused'
    assert calibration.intrinsics is None and calibration.sigma is None
    assert calibration.verdict.reasons and '\n' not in calibration.verdict.main_text
    return calibration.verdict.codes


@pytest.mark.parametrize('image', [np.zeros((64, 96, 3), np.uint8), np.zeros((64, 96), float)])
def test_a_picture_that_is_not_grey_is_named(image):
    with (limited(Calibrator(QUICK)) as calibrator,
          refused(InputError, 'E-FRAME-NOT-GREY', '64x96')):
        calibrator.push(Frame(0, 0, image))


@pytest.mark.parametrize('step', [0, 1, 100, 100_000, -100, -100_000_000])
def test_stamps_in_the_wrong_unit_are_named(step):
    image = np.zeros((64, 96), np.uint8)
    with limited(Calibrator(QUICK)) as calibrator, refused(InputError, 'E-STAMP-UNIT'):
        for n in range(20):
            calibrator.push(Frame(n, 1_700_000_000 + n * step, image))


def test_a_clock_that_is_set_back_at_once_is_no_wrong_unit():
    image = np.zeros((64, 96), np.uint8)
    with limited(Calibrator(QUICK)) as calibrator:
        for n in range(20):
            calibrator.push(Frame(n, 10**18 * (n < 3) + n * 100_000_000, image))


@pytest.mark.thorough
def test_a_drive_in_two_files_gives_what_the_whole_gives(drive, frames, result):
    """No turn is driven where the drive is cut, but both lose images of their straights there.

    test/frames has what reads several files.
    """
    cut = sum(drive.turn_centers) // 2
    found = calibrated([dataclasses.replace(frame, after_gap=frame.index == cut)
                        for frame in frames])
    assert len(found.turns) == 2 and all(turn.used for turn in found.turns)
    assert all(turn.last < cut or turn.first >= cut for turn in found.turns)
    for name, sigma in result.sigma.items():
        off = abs(found.intrinsics[name] - result.intrinsics[name])
        # a turn's window begins one image earlier: other keyframes, of which sigma knows
        assert off < sigma, name


def test_a_turn_that_the_end_of_a_file_cuts_is_whole_unless_images_are_lost(drive, frames, result):
    cut = round(drive.turn_centers[0])

    def turns(lost: int, end: int) -> list[tuple[int, int, int]]:
        detection = Detection(QUICK)
        for frame in frames[:cut]:
            detection.push(frame)
        # the files' stamps go on whatever is lost
        for frame, place in zip(frames[cut + lost:end], frames[cut:], strict=False):
            detection.push(dataclasses.replace(
                place, image=frame.image, perhaps_after_gap=place.index == cut))
        detection.finish()
        return sorted((turn.center, turn.first, turn.last) for turn in detection.turns())

    whole = sorted((turn.center, turn.first, turn.last) for turn in result.turns)
    assert whole[0][1] < cut < whole[0][2] and turns(0, len(frames)) == whole
    assert not any(first < cut <= last for _, first, last in turns(3, cut + 27))


def test_a_folder_is_calibrated_in_one_call(tmp_path):
    with pytest.raises(InputError):
        calibrate(tmp_path / 'nothing')
    for n in range(3):
        cv2.imwrite(str(tmp_path / f'{n}.png'), np.full((64, 96, 3), 50 * n, np.uint8))
    found = calibrate(tmp_path, fps=10.0, config=QUICK)
    assert found.verdict.level == 'refused' and found.frames == 3 and 'refused' in repr(found)


def test_no_image_and_one_image():
    assert refusal([]) == ('E-FEW-IMAGES',)
    assert refusal(pictures(1, 640, 360, 1)) == ('E-FEW-IMAGES',)


def test_black_pictures():
    assert 'E-NO-TURN' in refusal(pictures(80, 320, 180))


@pytest.mark.parametrize(('width', 'height'), [(32, 32), (1, 1), (400, 8)])
def test_tiny_pictures(width, height):
    refusal(pictures(80, width, height))
    refusal(pictures(80, width, height, 1))


def test_sensors_of_a_refused_drive_are_named():
    with limited(Calibrator(QUICK)) as calibrator:
        for frame in pictures(80, 320, 180):
            calibrator.push(frame)
        calibrator.sense(SensorStream(rate=Samples(np.arange(9.0), np.zeros((9, 3)))))
        found = calibrator.calibrate()
    assert found.verdict.level == 'refused'
    assert [each.code for each in found.warnings] == ['E-SENSOR-NO-TURNS']


def test_noise_is_no_drive():
    refusal(pictures(80, 320, 180, 7))


def test_a_picture_that_stands(frames):
    assert 'E-NO-TURN' in refusal(
        Frame(n, n * 10**8, frames[0].image) for n in range(80))


def test_a_drive_without_a_turn(drive, frames):
    """It ends before the first turn; test/detect has longer ones."""
    straight = frames[:drive.turn_centers[0] - 9]
    assert len(straight) > 16 and 'E-NO-TURN' in refusal(straight)


def test_a_change_of_size_is_named(frames):
    with Calibrator(QUICK) as calibrator:
        for frame in frames[:3]:
            calibrator.push(frame)
        small = Frame(3, frames[3].stamp_ns, frames[3].image[:180, :320])
        with refused(InputError, 'E-IMAGE-SIZE-CHANGES', '640x360', '320x180', 'frame 3'):
            calibrator.push(small)
        # the drive may go on with the old size
        assert calibrator.push(frames[3]).frames == 4


def test_large_pictures_are_shrunk_for_everything(monkeypatch):
    sizes = []
    with Calibrator(QUICK.replace({'max_width': 320})) as calibrator:
        motion = calibrator.detection._motion
        push = motion.push
        monkeypatch.setattr(motion, 'push', lambda frame: sizes.append(frame.size) or push(frame))
        for frame in pictures(5, 642, 362, 2):
            calibrator.push(frame)
        calibration = calibrator.calibrate()
    # 642 is halved twice: 321 does not fit
    assert set(sizes) == {(160, 90)}
    assert calibration.image_size == (642, 362)


def test_small_pictures_are_enlarged_for_everything(monkeypatch):
    sizes = []
    with Calibrator(QUICK) as calibrator:
        motion = calibrator.detection._motion
        push = motion.push
        monkeypatch.setattr(motion, 'push', lambda frame: sizes.append(frame.size) or push(frame))
        for frame in pictures(5, 320, 180, 2):
            calibrator.push(frame)
        calibration = calibrator.calibrate()
    assert set(sizes) == {(640, 360)}
    assert calibration.image_size == (320, 180)


def test_a_mask_fits_images_that_are_enlarged():
    picture = np.random.default_rng(0).integers(0, 255, (120, 320), np.uint8)
    mask = np.ones(picture.shape, bool)
    mask[101:] = False
    with Calibrator(mask=mask) as calibrator:
        calibrator.push(Frame(0, 10**9, picture))
        valid = calibrator.calibrate().mask
    assert valid is not None and valid.shape == (120, 320)
    assert valid[:101].all() and not valid[101:].any()
    # as large as these pictures, once it is enlarged: but it is not theirs
    large = picture.repeat(2, axis=0).repeat(2, axis=1)
    with Calibrator(mask=mask) as calibrator, refused(InputError, 'E-MASK-SIZE', '320x120'):
        calibrator.push(Frame(0, 10**9, large))


def test_a_mask_fits_images_that_are_shrunk():
    picture = np.random.default_rng(0).integers(0, 255, (900, 1600), np.uint8)
    mask = np.ones(picture.shape, bool)
    mask[801:] = False
    with Calibrator(mask=mask) as calibrator:
        calibrator.push(Frame(0, 10**9, picture))
        valid = calibrator.calibrate().mask
    # a row of the small picture holds rows 800 and 801, of which one is masked: both are then
    assert valid is not None and valid.shape == (900, 1600)
    assert valid[:800].all() and not valid[800:].any()
    with Calibrator(mask=mask[:, :-4]) as calibrator, pytest.raises(InputError):
        calibrator.push(Frame(0, 10**9, picture))
