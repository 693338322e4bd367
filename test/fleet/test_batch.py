# SPDX-License-Identifier: Apache-2.0
"""A fleet from its manifest to its tables: killed, started again, cut into shards, in memory."""
from __future__ import annotations

import csv
import errno
import io
import json
import os
import sys
from dataclasses import replace

import numpy as np
import pytest
from fleet_made import CONFIG, YAWS, Here, clip_of, lens_of, written
from made_drives import drive, images, smooth, write_bag, write_video
from refused import refused
from solving import remembered

from dashcalib_ros.errors import ConfigError, InputError, OutputError, coded
from dashcalib_ros.fleet import fuse, storage
from dashcalib_ros.fleet import rigs as fleet_rigs
from dashcalib_ros.fleet.batch import (
    batch,
    cameras_of,
    problems,
    publish_camera,
    shard_of,
    solve_camera,
)
from dashcalib_ros.fleet.clips import GONE, ClipResult
from dashcalib_ros.fleet.engine import LocalEngine
from dashcalib_ros.fleet.manifest import Row, read_manifest
from dashcalib_ros.fleet.tables import camera_folder
from dashcalib_ros.formats.rig import load_rig
from dashcalib_ros.store.scene_file import encoded
from dashcalib_ros.workers.worker import WorkerDiedError

FEW = {'tracks': 60, 'keyframes': 7}
FILES = ('cameras.parquet', 'cameras.csv', 'clips.parquet', 'clips.csv', 'overview.html')
# units of one model of lens: by chance a sound lens is written with more coefficients
SETTINGS = CONFIG.replace({'fleet.least_units': 3, 'model': 'radial'})


@pytest.fixture(scope='module', autouse=True)
def solved_once():
    """Solve the same turns once: what is tested is which are solved, and what is kept of it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fuse, 'solve', remembered(fuse.solve))
        yield


class Flaky(Here):
    """A worker that is lost after some calls."""

    def __init__(self, calls: int) -> None:
        self.calls = calls

    def call(self, function, *arguments, progress=None):
        self.calls -= 1
        if self.calls < 0:
            raise KeyboardInterrupt
        return super().call(function, *arguments)


class Counting(Here):
    """Counts the tasks that did something."""

    def __init__(self) -> None:
        self.done: list[str] = []

    def call(self, function, *arguments, progress=None):
        found = super().call(function, *arguments)
        task = arguments[0].__name__
        if task != 'publish_camera' and not found[0].again:
            self.done.append(task)
        return found


@pytest.fixture(scope='module')
def manifest(tmp_path_factory):
    """Five cameras of a model with a turn each, one with two; one without turns; two bad clips."""
    pytest.importorskip('pyarrow')
    folder = tmp_path_factory.mktemp('fleet')
    rows = []
    for n in range(5):
        written(clip_of(lens_of(1 + 0.004 * n), YAWS[n:n + 1], world=n, **FEW),
                folder / f'{n}.npz')
        rows.append([f'{n}.npz', f'cam {n}', 'acme'])
    written(clip_of(lens_of(1.0), YAWS[5:6], world=9, **FEW), folder / 'second.npz')
    write_video(folder / 'still.avi', smooth(), fps=10.0)
    (folder / 'empty.mp4').write_bytes(b'')
    rows += [['second.npz', 'cam 0', 'acme'], ['still.avi', 'cam 5', ''],
             ['empty.mp4', 'cam 1', 'acme'], ['gone.mp4', 'cam 5', 'acme'],
             ['0.npz', 'cam 0', 'acme']]
    with (folder / 'm.csv').open('w', newline='') as stream:
        csv.writer(stream).writerows([['clip', 'camera', 'camera_model'], *rows])
    return folder / 'm.csv'


def calibrate(rows, out, worker=None, shard=None, **options):
    """Return the cameras, and the files that tell of all."""
    cameras = cameras_of(rows, shard or (1, 1))
    engine = LocalEngine(3, [worker or Here()])
    files, rigs = batch(cameras, str(out), SETTINGS, engine, shard is None, **options)
    assert rigs == {}
    return cameras, files


def run(manifest, out, worker=None, shard=None):
    return calibrate(read_manifest(str(manifest)), out, worker, shard)


@pytest.fixture(scope='module')
def reference(manifest, tmp_path_factory):
    out = tmp_path_factory.mktemp('reference')
    return out, run(manifest, out)


def rows_of(path):
    from pyarrow import parquet
    return parquet.read_table(path).to_pylist()


@pytest.mark.thorough
def test_the_tables_tell_everything(reference):
    out, (found, _) = reference
    cameras = {row['camera']: row for row in rows_of(out / 'cameras.parquet')}
    clips = rows_of(out / 'clips.parquet')
    assert list(cameras) == [f'cam {n}' for n in range(6)]
    assert [row['row'] for row in clips] == list(range(1, 11))
    status = {row['clip']: row['status'] for row in clips[:9]}
    assert status == {**{f'{n}.npz': 'used' for n in range(5)}, 'second.npz': 'used',
                      'still.avi': 'no turn', 'empty.mp4': 'unreadable', 'gone.mp4': 'unreadable'}
    assert clips[9]['status'] == 'left out' and 'row 1' in clips[9]['reason']
    assert clips[7]['reason'].endswith('[E-FILE-EMPTY]')
    assert clips[8]['reason'].endswith('[E-CLIP-MISSING]')
    two = cameras['cam 0']
    assert two['turns_used'] == 2 == two['clips_used'] and two['clips'] == 3
    assert cameras['cam 5']['verdict'] == 'refused'
    assert cameras['cam 5']['reason_codes'] == ['E-NO-TURN']
    for n in range(1, 5):
        row = cameras[f'cam {n}']
        assert (row['verdict'], row['verdict_alone'], row['prior_units']) == ('weak', 'weak', 4)
        assert 0 < row['prior_share'] < 1
        assert row['reason_codes'][0] == 'E-PRIOR-USED'
        for value in (f'{100 * row["prior_share"]:.0f} %', 'acme', '4 other cameras'):
            assert value in row['reasons'][0]
        assert row['sigma_fx_alone'] > 0 and row['sigma_k1_alone'] > 0
        folder = out / row['folder']
        result = json.loads((folder / 'result.json').read_text())
        assert result['intrinsics']['fx'] == row['fx']
        assert result['mount']['verdict'] == row['mount_verdict'] == 'weak'
        assert (folder / 'calibration.weak.yaml').exists()
    page = (out / 'overview.html').read_text()
    assert '6 cameras, 10 clips' in page and camera_folder('cam 1').split('/')[1] in page
    assert {row.clip for row, _ in problems(found)} == {'empty.mp4', 'gone.mp4'}


def same(one, other):
    return all((one / name).read_bytes() == (other / name).read_bytes() for name in FILES)


def test_killed_at_any_time_it_does_only_what_is_missing(manifest, reference, tmp_path):
    done = []
    for calls in (3, 9, 14, 99):
        worker = Flaky(calls)
        try:
            run(manifest, tmp_path, worker)
        except KeyboardInterrupt:
            done.append(len(list(tmp_path.rglob('clips/*/*.json'))))
            assert not list(tmp_path.rglob('*.tmp'))
        else:
            done.append(99)
    assert done[-1] == 99 and done[0] == 2 and done == sorted(done)
    assert same(tmp_path, reference[0])
    again = Counting()
    run(manifest, tmp_path, again)
    # what is not there is looked for each time, without a task
    assert again.done == []
    assert same(tmp_path, reference[0])


def test_shards_and_a_merge_give_the_same_tables(manifest, reference, tmp_path):
    parts = [run(manifest, tmp_path, shard=(n, 3)) for n in (3, 1, 2)]
    assert [len(cameras) for cameras, _ in parts] == [2, 2, 2] and not parts[0][1]
    worker = Counting()
    run(manifest, tmp_path, worker)
    assert worker.done == [] and same(tmp_path, reference[0])


def test_input_and_output_may_be_addresses(manifest, reference, monkeypatch):
    fsspec = pytest.importorskip('fsspec')
    monkeypatch.setattr(storage, 'SCHEMES', (*storage.SCHEMES, 'memory'))
    memory = fsspec.filesystem('memory')
    memory.store.clear()
    memory.put(str(manifest.parent) + '/', 'memory://bucket/in', recursive=True)
    run('memory://bucket/in/m.csv', 'memory://bucket/out')
    for name in FILES:
        assert memory.cat(f'memory://bucket/out/{name}') == (reference[0] / name).read_bytes()
    place = f'memory://bucket/out/{camera_folder("cam 0")}'
    assert memory.exists(f'{place}/result.json')
    # the report names this place, and no scratch folder
    assert f'{place}/calibration' in memory.cat(f'{place}/report.html').decode()
    theirs = {'calibration.yaml': b'theirs: 1', 'calibration.weak.yaml': b'theirs: 2'}
    for name, data in theirs.items():
        memory.pipe_file(f'{place}/{name}', data)
    run('memory://bucket/in/m.csv', 'memory://bucket/out')
    kept = [memory.cat(name) for name in memory.ls(place, detail=False) if 'calibration' in name]
    assert set(theirs.values()) <= set(kept) and len(kept) == 3


def test_next_months_clips_need_no_old_video(manifest, tmp_path):
    video = write_video(tmp_path / 'still.avi', smooth(), fps=10.0)
    row = Row(1, 'still.avi', str(video), 'cam')
    for _ in range(2):
        cameras, _ = calibrate([row], tmp_path / 'out')
        assert not list(problems(cameras))
        video.unlink(missing_ok=True)
    # but another clip under its name is read
    video.write_bytes(b'')
    cameras, _ = calibrate([row], tmp_path / 'out')
    assert next(problems(cameras))[1].endswith(' [E-FILE-EMPTY]')


def test_a_clip_that_kills_its_worker_is_set_aside(manifest, tmp_path):
    class Deadly(Here):
        def call(self, function, *arguments, progress=None):
            if getattr(arguments[1], 'number', None) == 2:
                raise WorkerDiedError('E-WORKER-DIED', 'the worker died')
            return super().call(function, *arguments)

    for worker in (Deadly(), Here()):
        cameras, _ = run(manifest, tmp_path, worker)
        found = {row.number: why for row, why in problems(cameras)}
        # the second time it is not even tried
        assert found[2].endswith('[E-CLIP-SET-ASIDE]') and set(found) == {2, 8, 9}
    assert {row['camera']: row['verdict'] for row in rows_of(tmp_path / 'cameras.parquet')}[
        'cam 1'] == 'refused'


@pytest.mark.parametrize('files', [0, 1, 3, 8, 20])
@pytest.mark.parametrize('number', [errno.ENOSPC, errno.EFBIG])
def test_a_full_disk_ends_it_and_publishes_no_refusal(manifest, reference, tmp_path, monkeypatch,
                                                      number, files):
    left = iter(range(files))

    def full(handle):
        if next(left, None) is None:
            raise OSError(number, os.strerror(number))

    monkeypatch.setattr('os.fsync', full)
    with refused(OutputError, 'E-DISK-FULL'):
        run(manifest, tmp_path)
    monkeypatch.undo()
    assert not any((tmp_path / name).exists() for name in ('cameras.csv', 'overview.html'))
    assert not list(tmp_path.rglob('cameras'))
    if files == 20:
        run(manifest, tmp_path)
        assert same(tmp_path, reference[0])


def test_a_full_scratch_disk_is_no_fault_of_a_clip(manifest, tmp_path, monkeypatch):
    def full(path):
        raise OSError(errno.ENOSPC, 'No space left on device')
    monkeypatch.setattr('dashcalib_ros.fleet.storage.local_copy', full)
    with refused(OutputError, 'E-SCRATCH-FULL'):
        run(manifest, tmp_path)


def test_credentials_of_a_manifest_are_written_nowhere(tmp_path, monkeypatch):
    fsspec = pytest.importorskip('fsspec')
    monkeypatch.setattr(storage, 'SCHEMES', ('memory',))
    memory = fsspec.filesystem('memory')
    memory.store.clear()
    clip = encoded(clip_of(yaws=YAWS[:1], **FEW))
    places = ['user:xyzzy@bucket/a.npz', 'bucket/b.npz?sig=xyzzy', 'bucket/gone?key=xyzzy']
    for place in places[:2]:
        memory.pipe_file(f'memory://{place}', clip)
    (tmp_path / 'm.csv').write_text('clip\n' + '\n'.join(
        [*(f'memory://{place}' for place in places), 'github://user:xyzzy@/a.mp4',
         'zip://x::s3://KEY:xyzzy@b/a.zip']))
    run(tmp_path / 'm.csv', tmp_path / 'out')
    rows = list(csv.DictReader((tmp_path / 'out' / 'clips.csv').read_text().splitlines()))
    assert [row['status'] for row in rows][2:] == ['unreadable'] * 3
    assert [row['clip'].partition('***')[0] for row in rows] == [
        'memory://', 'memory://bucket/b.npz?', 'memory://bucket/gone?', 'github://', 'zip://']
    found = [path for path in (tmp_path / 'out').rglob('*') if path.is_file()]
    assert not [path for path in found if b'xyzzy' in path.read_bytes() or 'xyzzy' in str(path)]
    assert len(found) > 6


def test_ten_thousand_unreadable_clips(tmp_path):
    (tmp_path / 'bad.avi').write_bytes(b'')
    rows = [Row(n, f'{n}.avi', str(tmp_path / 'gone.avi')) for n in range(10_000)]
    rows.append(Row(10_000, 'bad.avi', str(tmp_path / 'bad.avi')))
    for row in rows[:-1]:
        assert row.camera == ''
    few = [Row(row.number, row.clip, row.place, 'cam') for row in rows]
    cameras, _ = calibrate(few, tmp_path / 'out')
    assert len(list(problems(cameras))) == 10_001
    assert cameras[0].verdict == 'refused'


def test_clips_that_are_not_there_cost_no_task_and_no_files(tmp_path):
    class NoWorker(Here):
        def call(self, function, *arguments, progress=None):
            raise AssertionError(arguments)
    rows = [Row(n, f'{n}.avi', str(tmp_path / f'{n}.avi'), f'cam{n % 7}') for n in range(2000)]
    rows += [Row(2000, '', '', problem='names no clip'), Row(2001, 'a\0b', 'a\0b', 'cam0')]
    cameras, _ = calibrate(rows, tmp_path / 'out', NoWorker())
    found = list(problems(cameras))
    assert len(found) == 2002 and {why for row, why in found if row.clip} == {coded(GONE)}
    [why] = [why for row, why in found if not row.clip]
    assert why.endswith(' [E-MANIFEST-ROW]')
    assert not any((tmp_path / 'out' / each).exists() for each in ('cameras', 'clips'))
    told = {row['camera']: row for row in csv.DictReader(
        (tmp_path / 'out' / 'cameras.csv').read_text().splitlines())}
    assert told['cam1']['verdict'] == 'refused' and told['cam1']['clips_unreadable'] == '286'
    assert told['cam1']['reasons'].endswith('[E-CLIPS-MISSING]')


def test_without_pyarrow_the_tables_are_json_lines(tmp_path, monkeypatch):
    # with NumPy 1, as ROS's own is, pyarrow is installed and cannot be imported
    monkeypatch.setitem(sys.modules, 'pyarrow', None)
    row = Row(1, 'gone.mp4', str(tmp_path / 'gone.mp4'))
    _, files = calibrate([row], tmp_path)
    assert files == ('cameras.jsonl', 'cameras.csv', 'clips.jsonl', 'clips.csv', 'overview.html')
    line, = (tmp_path / 'clips.jsonl').read_text().splitlines()
    assert json.loads(line)['status'] == 'unreadable'


@pytest.mark.parametrize('text', ['0/2', '3/2', '1', '1/0', 'a/b', '-1/2', ''])
def test_bad_shards(text):
    with refused(ConfigError, 'E-SHARD-INVALID'):
        shard_of(text)


@pytest.mark.parametrize('use', [
    lambda out: publish_camera('solved/00/1.json', None, [], out),
    lambda out: solve_camera('cam', '', [
        (Row(1, 'a.mp4', '/a.mp4', 'cam'), ClipResult(file='gone.npz'))], out, SETTINGS)])
def test_what_was_removed_from_the_output_meanwhile_is_named(tmp_path, use):
    with refused(InputError, 'E-FLEET-FILE-CHANGED'):
        use(str(tmp_path))


def hostile(data, place):
    """Spoil gathered turns in every way that once cost the tables, or the camera."""
    arrays = dict(np.load(io.BytesIO(data)))
    text = json.loads(str(arrays['about']))
    odd = [{'turns': [{**text['turns'][0], 'stamp_s': stamp}]} for stamp in ('x', 10**400)]
    odd += [{'frames': 1e308}, {'content': '../../../escaped'}, {'settings': '../../escaped'}]
    files = [{**arrays, 'about': np.asarray(json.dumps({**text, **about}))} for about in odd]
    files += [{**arrays, 'turn0.rotations': factor * arrays['turn0.rotations']}
              for factor in (1e300, 0.0, 2.0)]
    for n, file in enumerate(files):
        np.savez(place / f'hostile{n}.npz', **file)
        yield f'hostile{n}.npz'


def test_a_hostile_clip_costs_its_row_only(tmp_path):
    pytest.importorskip('pyarrow')
    clips = tmp_path / 'clips'
    for n in range(2):
        path = written(clip_of(lens_of(), YAWS[n:n + 1], world=n, **FEW), clips / f'{n}.npz')
    bad = list(hostile(path.read_bytes(), clips))
    (clips / 'zero.npz').symlink_to('/dev/zero')
    os.mkfifo(clips / 'fifo.avi')
    bad += ['zero.npz', 'fifo.avi']
    rows = [Row(n, name, str(clips / name), 'cam')
            for n, name in enumerate(['0.npz', *bad, '1.npz'], 1)]
    cameras, _ = calibrate(rows, tmp_path / 'out')
    assert [row.clip for row, _ in problems(cameras)] == bad
    codes = [why.rpartition('[')[2] for _, why in problems(cameras)]
    assert codes == ['E-GATHERED-DAMAGED]'] * (len(bad) - 2) + ['E-FILE-NOT-REGULAR]'] * 2
    camera, = rows_of(tmp_path / 'out' / 'cameras.parquet')
    assert (camera['clips_used'], camera['clips_unreadable']) == (2, len(bad))
    assert not list(tmp_path.rglob('*escaped*'))


def test_another_topic_of_a_bag_is_another_clip(tmp_path):
    bag = write_bag(tmp_path / 'bag', [*images(drive(12), '/left'),
                                       *images(drive(8), '/right')])
    for camera in ('cam', ''):
        rows = [Row(n, 'bag', str(bag), camera, topic=topic)
                for n, topic in enumerate(('/left', '/right', '/right'), 1)]
        cameras, _ = calibrate(rows, tmp_path / 'out')
        assert len(cameras) == (1 if camera else 2) and not list(problems(cameras))
        left, right, again = rows_of(tmp_path / 'out' / 'clips.parquet')
        assert [row['frames'] for row in (left, right)] == [12, 8]
        assert left['status'] == right['status'] == 'no turn'
        assert again['status'] == 'left out' and 'row 2' in again['reason']


def test_names_of_cameras_never_share_a_folder():
    names = ['a b', camera_folder('a b').split('/')[1], 'a_b-541e27fe', 'a_b',
             'a/b', '../a', '..', 'CON', 'é', 'x' * 300, 'a b ', 'cameras']
    folders = [camera_folder(name) for name in names]
    assert len(set(folders)) == len(names)
    assert all(folder.count('/') == 1 and '..' not in folder for folder in folders)


DATE_S = 1.7e9


def car(folder, name, first=0, **options):
    """Write a clip of a camera of one car, from the first of its turns on."""
    clip = clip_of(yaws=YAWS[first:first + 2], world=first, tracks=150, keyframes=14)
    rng, turns = np.random.default_rng(len(name)), []
    for n, turn in enumerate(clip.turns):
        tracks = turn.scene.tracks
        turns.append(replace(turn, scene=replace(turn.scene, tracks=replace(
            tracks, stamps_ns=tracks.stamps_ns + 40_000_000_000 * n,
            # noise of its own
            xy=(tracks.xy + 0.1 * rng.normal(size=tracks.xy.shape)).astype(np.float32))),
            stamp_s=40.0 * n + 1.0))
    written(replace(clip, turns=tuple(turns), content=f'{len(name):032x}'),
            folder / f'{name}.npz')
    return {'clip': f'{name}.npz', 'camera': name, 'rig': 'car 1', **options}


def fleet(folder, rows, worker=None):
    (folder / 'm.jsonl').write_text('\n'.join(map(json.dumps, rows)))
    cameras = cameras_of(read_manifest(str(folder / 'm.jsonl')))
    return batch(cameras, str(folder / 'out'), SETTINGS, LocalEngine(3, [worker or Here()]))[1]


@pytest.mark.thorough
def test_the_cameras_of_a_car_are_a_rig(tmp_path, monkeypatch):
    rows = [car(tmp_path, 'front', time=DATE_S), car(tmp_path, 'side', time=DATE_S + 2),
            # of another day, and of a car with one camera
            car(tmp_path, 'rear', time=DATE_S + 1e6),
            {**car(tmp_path, 'front', rig='car 2'), 'camera': 'alone'}]
    rigs = fleet(tmp_path, rows)
    # two small turns are few
    assert rigs['car 1'] == {'front': 'accepted', 'side': 'weak', 'rear': 'refused'}
    assert 'alone' in rigs['car 2'] and rigs['car 2'].endswith(' [E-RIG-ONE-CAMERA]')
    assert set(rigs) == {'car 1', 'car 2'}
    folder, = (tmp_path / 'out' / 'rigs').iterdir()
    found = load_rig(folder)
    side = found.cameras['side']
    assert (folder / side.calibration).resolve() == (
        tmp_path / 'out' / 'cameras' / 'side' / 'result.json')
    # both are one and the same
    assert np.all(np.abs(side.rotation_deg) < 3.5 * np.array(side.rotation_sigma_deg))
    assert max(side.rotation_sigma_deg) < 1.0 and (folder / 'rig.urdf').exists()
    assert abs(side.time_offset_s - 2.0) < 0.05
    assert [each.code for each in found.cameras['rear'].reasons] == ['E-RIG-NO-SHARED']
    # what was solved is not solved again
    monkeypatch.setattr(fleet_rigs, 'rig_of_scenes', None)
    assert fleet(tmp_path, rows) == rigs


def test_a_rig_of_several_drives_needs_their_dates(tmp_path):
    rows = [car(tmp_path, 'front'), car(tmp_path, 'side'),
            {**car(tmp_path, 'more', first=2), 'camera': 'front'}]
    assert fleet(tmp_path, rows)['car 1'].endswith('[E-RIG-NO-TIMES]')
