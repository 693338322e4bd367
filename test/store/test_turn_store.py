# SPDX-License-Identifier: Apache-2.0
"""Turns on disk: what is written comes back, what is not ours is left alone, nothing raises."""
from __future__ import annotations

import fcntl
import io
import json
import os
import threading
import tracemalloc
import zipfile
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from refused import refused
from synthetic import LENS, synthetic_turn

from dashcalib_ros.camera import Fisheye
from dashcalib_ros.detect import TurnId
from dashcalib_ros.errors import InputError
from dashcalib_ros.input.scale import Scale
from dashcalib_ros.reconstruct.scene import Scene, Start
from dashcalib_ros.solve.start import kinds_of_lenses
from dashcalib_ros.store import scene_file
from dashcalib_ros.store import turn_store as room
from dashcalib_ros.store.scene_file import Origin, StoredTurn
from dashcalib_ros.store.turn_store import TurnStore

HALF_WIDTH_S = 3.0
DATE_S = 1_767_614_400.0
CAMERA = Origin((800, 450), Scale(), 'camera')


@cache
def scene(seed: int = 0, center: int = 30) -> Scene:
    made = synthetic_turn(keyframes=8, tracks=60, world=seed, seed=seed).scene(LENS, center)
    # as in a file
    xy = made.tracks.xy.astype(np.float32).astype(float)
    return replace(made, tracks=replace(made.tracks, xy=xy))


def stored(seed: int = 0, prominence: float = 0.05) -> StoredTurn:
    return StoredTurn(scene(seed), DATE_S + 60 * seed, prominence)


@pytest.fixture
def make(tmp_path):
    """Stores over one folder; what they warn of is in their list `said`."""
    def store(origin: Origin = CAMERA, folder=tmp_path / 'turns', capacity: int = 10,
                use: bool = True) -> TurnStore:
        said: list[str] = []
        made = TurnStore(str(folder), capacity, HALF_WIDTH_S, said.append)
        made.said = said
        made.load(origin, use)
        return made

    return store


def hold(store: TurnStore, *turns: StoredTurn, first: int = 100) -> None:
    """Give an store these turns of its drive, beside those of earlier drives."""
    own = {TurnId.at(first + n): turn for n, turn in enumerate(turns)}
    store.mirror({**store.turns, **own})


def names(store: TurnStore) -> set[str]:
    return {path.name for path in store._folder.iterdir()}


def same(a: Scene, b: Scene) -> bool:
    """Tell whether two scenes are equal to the last bit, but for whose they are."""
    pairs = [(a.tracks.frames, b.tracks.frames), (a.tracks.xy, b.tracks.xy),
             (a.profile.ratios, b.profile.ratios), (a.profile.costs, b.profile.costs)]
    pairs += [(getattr(a.structure, name), getattr(b.structure, name)) for name in (
        'rotations', 'translations', 'points', 'registered', 'used')]
    for one, other in zip(a.rivals, b.rivals, strict=True):
        pairs += [(one.profile.ratios, other.profile.ratios),
                  (one.profile.costs, other.profile.costs)]
    return all(x.dtype == y.dtype and np.array_equal(x, y, equal_nan=True) for x, y in pairs) and (
        (a.camera, a.tracks.image_size, a.profile.observations, [r.camera for r in a.rivals])
        == (b.camera, b.tracks.image_size, b.profile.observations, [r.camera for r in b.rivals]))


def test_a_turn_through_a_fisheye_comes_back(make):
    size = scene(0).tracks.image_size
    wide = replace(scene(0), camera=Fisheye(size, 300.0, 301.0, 400.0, 220.0, 0.02, -0.01, 0.002))
    hold(make(), StoredTurn(wide, DATE_S, 0.05))
    [found] = make().turns.values()
    assert same(found.scene, wide)


def test_stored_turns_vote_for_each_kind_of_lens_that_was_tried(make):
    """Half of the turns must have tried a kind: without it, a fisheye's bank is a pinhole's."""
    wide = Fisheye.centred(scene(0).tracks.image_size, 400.0)
    both = replace(scene(0), rivals=(Start(scene(0).profile, wide),))
    hold(make(), StoredTurn(both, DATE_S, 0.05))
    [found] = make().turns.values()
    assert same(found.scene, both)
    assert set(kinds_of_lenses([found.scene])) == {'pinhole', 'fisheye'}


def test_what_is_stored_comes_back_with_keys_of_its_own(make):
    turns = [stored(n, 0.01 * (n + 1)) for n in range(3)]
    hold(make(), *turns)
    found = make()
    assert list(found.turns) == [TurnId.stored(n) for n in range(3)] and found.said == []
    for key, turn in zip(found.turns, reversed(turns), strict=True):
        back = found.turns[key]
        assert same(back.scene, turn.scene) and back.scene.turn == key
        assert (back.stamp_s, back.prominence) == (turn.stamp_s, turn.prominence)
        assert back.scene.yaw_deg == turn.scene.yaw_deg
        # as every array of a scene
        assert back.scene.structure.points.flags.writeable


def test_without_a_folder_nothing_is_done(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    store = TurnStore('', 10, HALF_WIDTH_S, pytest.fail)
    store.load(CAMERA)
    hold(store, stored())
    store.clear()
    assert store.turns == {} and list(tmp_path.iterdir()) == []


def test_home_is_expanded(make, tmp_path, monkeypatch):
    monkeypatch.setenv('HOME', str(tmp_path / 'home'))
    hold(make(folder='~/turns'), stored())
    assert len(list((tmp_path / 'home' / 'turns').iterdir())) == 1


def test_the_home_of_nobody_costs_one_warning(make, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    store = make(folder='~nobody-of-this-name/turns')
    hold(store, stored())
    store.clear()
    assert store.turns == {} and list(tmp_path.iterdir()) == []
    assert [each.code for each in store.said] == ['E-STORE-HOME']


def test_turns_that_are_gone_from_the_bank_are_gone_from_the_folder(make):
    store = make()
    hold(store, stored(0), stored(1))
    before = names(store)
    hold(store, stored(0), stored(1))
    assert names(store) == before  # nothing is written twice
    hold(store, stored(0))
    assert names(store) < before and len(names(store)) == 1
    # a prominence that has grown is written anew
    hold(store, stored(0, 0.08))
    assert len(names(store)) == 1 and make().turns[TurnId.stored(0)].prominence == 0.08


def test_the_most_prominent_stay_whoever_wrote_them(make):
    hold(make(capacity=3), *(stored(n, 0.01 * (n + 1)) for n in range(3)))
    store = make(capacity=3)
    own = stored(7, 0.025), stored(8, 0.005)
    hold(store, *own)
    assert [round(turn.prominence, 3) for turn in make().turns.values()] == [0.03, 0.025, 0.02]
    # what was pushed out does not come back
    hold(store, *own)
    assert len(names(store)) == 3


def test_the_same_turn_counts_once(make):
    first = stored(0)
    hold(make(), first)
    hold(make(use=False), first)  # two processes, one drive
    store = make()
    assert len(store.turns) == 1 and len(names(store)) == 1
    # by its time, where the clock tells the date
    assert not store.drop_repeated([DATE_S - 4, DATE_S + 4])
    assert store.drop_repeated([DATE_S + 2]) and store.turns == {}
    # by its pictures
    store = make()
    assert not store.drop_repeated((), [scene(1)])
    assert store.drop_repeated((), [scene(0, center=77)])
    # two videos that both begin at 0 s are two drives
    early = [replace(stored(n), stamp_s=12.0) for n in (3, 4)]
    hold(make(), *early)
    assert len(make().turns) == 3


@pytest.mark.parametrize('other', [
    Origin((640, 450), Scale(), 'camera'), Origin((800, 450), Scale(2), 'camera'),
    Origin((800, 450), Scale(enlarge=2), 'camera'), Origin((800, 450), Scale(), 'rear')],
    ids=['size', 'shrink', 'enlarge', 'frame'])
def test_another_camera_is_left_out_with_one_warning(make, other):
    hold(make(), stored(0), stored(1))
    store = make(other)
    assert store.turns == {}
    assert [each.code for each in store.said] == ['E-STORE-OTHER-CAMERA']
    assert '2 files in' in str(store.said[0]) and str(other) in str(store.said[0])
    # they are left alone, and do not take the others' places
    hold(store, stored(2))
    assert len(names(store)) == 3
    assert len(make().turns) == 2
    store.clear()
    assert len(make().turns) == 2


def test_turns_of_resized_images_come_back(make):
    for scale, size in ((Scale(enlarge=2), (400, 225)), (Scale(shrink=2), (1601, 900))):
        hold(make(Origin(size, scale)), stored())
        assert len(make(Origin(size, scale)).turns) == 1


def test_a_camera_frame_that_is_not_known_fits_any(make):
    hold(make(Origin((800, 450))), stored())
    assert len(make().turns) == len(make(Origin((800, 450))).turns) == 1


def bare(path, values) -> None:
    """Write an array that is in no store."""
    with path.open('wb') as stream:
        np.save(stream, values, allow_pickle=True)


def rewritten(path, about=(), **changes) -> None:
    """Change arrays of a turn, and values in the text; None removes an array."""
    with np.load(path) as data:
        values = {**data, **{f'turn0.{name}': value for name, value in changes.items()}}
    text = {**json.loads(str(values['about'])), **dict(about)}
    values['about'] = np.asarray(json.dumps(text))
    np.savez(path, **{name: value for name, value in values.items() if value is not None})


def scaled(path, name: str, factor: float) -> None:
    with np.load(path) as data:
        rewritten(path, **{name: factor * data[f'turn0.{name}']})


def bomb(path, compression: int, times: int = 20) -> None:
    """Write arrays of zeros: 8 MB each, a few thousand bytes in the file."""
    with np.load(path) as data:
        values = {**data}
    with zipfile.ZipFile(path, 'w', compression) as archive:
        for name, value in values.items():
            stream = io.BytesIO()
            np.save(stream, value)
            archive.writestr(f'{name}.npy', stream.getvalue())
        for n in range(times):
            archive.writestr(f'zeros{n}.npy', npy_header((1_000_000,)) + bytes(8_000_000))


def npy_header(shape: tuple[int, ...]) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        stream, {'descr': '<f8', 'fortran_order': False, 'shape': shape})
    return stream.getvalue()


def boast(path) -> None:
    """Have an array's header promise far more than follows."""
    with np.load(path) as data:
        values = {**data}
    np.savez(path, **{name: value for name, value in values.items() if name != 'turn0.xy'})
    with zipfile.ZipFile(path, 'a') as archive:
        archive.writestr('turn0.xy.npy', npy_header((8, 10**9, 2)) + bytes(64))


SPOILED = {
    'empty': lambda path: path.write_bytes(b''),
    'noise': lambda path: path.write_bytes(os.urandom(5000)),
    'cut off': lambda path: path.write_bytes(path.read_bytes()[:-4000]),
    'flipped': lambda path: path.write_bytes(
        path.read_bytes()[:3000] + b'\xff' * 2000 + path.read_bytes()[5000:]),
    'foreign': lambda path: np.savez(path, weights=np.zeros(3)),
    'pickle': lambda path: np.savez(path, about=np.array([{}], object)),
    'an array': lambda path: bare(path, np.zeros(3)),
    'newer': lambda path: rewritten(path, {'format': scene_file.FORMAT + 1}),
    'older': lambda path: np.savez(path, format=3, xy=np.zeros((8, 60, 2))),
    'huge rotations': lambda path: scaled(path, 'rotations', 1e300),
    'huge points': lambda path: scaled(path, 'points', 1e300),
    'incomplete': lambda path: rewritten(path, rotations=None),
    'other shape': lambda path: rewritten(path, points=np.zeros((3, 3))),
    'other type': lambda path: rewritten(path, used=np.zeros((8, 60))),
    'not finite': lambda path: rewritten(path, camera=np.full(6, np.nan)),
    'no points': lambda path: rewritten(path, points=np.full((60, 3), np.nan)),
    'no scale': lambda path: rewritten(path, {'scale': {'shrink': 0, 'enlarge': 1}}),
    'no turns': lambda path: rewritten(path, {'turns': []}),
    'no scene': lambda path: rewritten(path, used=np.zeros((8, 60), bool)),
    'too large': lambda path: path.write_bytes(path.read_bytes() + bytes(scene_file.LARGEST)),
    'a folder': lambda path: path.unlink() or path.mkdir(),
    'a FIFO': lambda path: path.unlink() or os.mkfifo(path),
    'a link to nothing': lambda path: path.unlink() or path.symlink_to('nowhere'),
    'a link to a device': lambda path: path.unlink() or path.symlink_to('/dev/full'),
    'bomb': lambda path: bomb(path, zipfile.ZIP_DEFLATED),
    'bomb of another kind': lambda path: bomb(path, zipfile.ZIP_LZMA, 1),
    'boastful': lambda path: boast(path),
}
# of what is not even read
CODES = {'too large': 'E-FILE-TOO-LARGE', 'a link to nothing': 'E-FILE-MISSING', **dict.fromkeys(
    ('a folder', 'a FIFO', 'a link to a device'), 'E-FILE-NOT-REGULAR')}


@pytest.mark.parametrize('kind', SPOILED)
def test_a_file_of_no_use_is_left_out_with_one_warning(make, kind):
    store = make()
    hold(store, stored(0), stored(1))
    victim = sorted(store._folder.iterdir())[0]
    SPOILED[kind](victim)
    found = make()
    assert len(found.turns) == 1
    [notice] = found.said
    assert notice.code == 'E-STORE-FILES' and victim.name in str(notice)
    assert '\n' not in str(notice)
    with refused(InputError, CODES.get(kind, 'E-TURN-FILE'), victim.name):
        found._read(victim.name)
    # it stays, and is in nobody's way
    hold(found, stored(5), stored(6))
    assert victim.name in names(found) and len(make().turns) == 3


@pytest.mark.parametrize('kind', ['bomb', 'boastful'])
def test_a_small_file_takes_little_memory(make, kind):
    store = make()
    hold(store, stored(0))
    [path] = store._folder.iterdir()
    if kind == 'boastful':
        boast(path)
    else:
        bomb(path, zipfile.ZIP_DEFLATED)
    assert path.stat().st_size < scene_file.LARGEST
    tracemalloc.start()
    try:
        assert make().turns == {}
        assert tracemalloc.get_traced_memory()[1] < scene_file.LARGEST_UNPACKED
    finally:
        tracemalloc.stop()


def test_what_cannot_be_used_is_named(make):
    store = make()
    hold(store, stored(0))
    os.mkfifo(store._folder / 'pipe.npz')
    (store._folder / 'gone.npz').symlink_to('nowhere')
    (store._folder / 'folder.npz').mkdir()
    found = make()
    assert len(found.turns) == 1 and len(found.said) == 1
    assert found.said[0].code == 'E-STORE-FILES' and all(
        name in str(found.said[0]) for name in ('pipe.npz', 'gone.npz', 'folder.npz'))
    hold(found, stored(1))
    assert {'pipe.npz', 'gone.npz', 'folder.npz'} < names(found)


def test_nothing_is_ever_unpickled(make, tmp_path):
    class Trap:
        def __reduce__(self):
            return (os.mkdir, (str(tmp_path / 'sprung'),))

    hold(make(), stored())
    folder = tmp_path / 'turns'
    np.savez(folder / 'trap.npz', about=np.array([Trap()], object))
    bare(folder / 'bare.npz', np.array([Trap()], object))
    assert len(make().turns) == 1
    assert not (tmp_path / 'sprung').exists()


def test_a_folder_that_cannot_be_written_to_costs_one_warning(make, tmp_path):
    (tmp_path / 'file').write_text('in the way')
    store = make(folder=tmp_path / 'file' / 'turns')
    hold(store, stored(0))
    hold(store, stored(0), stored(1))
    assert [each.code for each in store.said] == ['E-STORE-NOT-WRITABLE']
    store.clear()


@pytest.mark.skipif(os.geteuid() == 0, reason='root may write anywhere')
def test_a_read_only_folder_is_read(make, tmp_path):
    hold(make(), stored(0))
    folder = tmp_path / 'turns'
    folder.chmod(0o555)
    try:
        store = make()
        assert len(store.turns) == 1
        hold(store, stored(1))
        store.mirror({})
        assert len(store.said) == 1 and 'Permission denied' in str(store.said[0])
        assert len(names(store)) == 1
    finally:
        folder.chmod(0o755)


def test_a_full_disk_leaves_nothing_half_written(make, monkeypatch):
    store = make()
    hold(store, stored(0))

    def full(handle):
        raise OSError(28, os.strerror(28))

    with monkeypatch.context() as patch:
        patch.setattr(room.os, 'fsync', full)
        hold(store, stored(0), stored(1))
        hold(store, stored(0), stored(1))
    assert len(store.said) == 1 and 'disk space' in str(store.said[0])
    assert len(names(store)) == 1
    # there is space again
    hold(store, stored(0), stored(1))
    assert len(make().turns) == 2


def test_what_a_dead_process_left_half_written_is_removed(make, tmp_path):
    folder = tmp_path / 'turns'
    folder.mkdir()
    dead, living = (folder / f'.turn-{n:016x}.npz.0123abcd.tmp' for n in range(2))
    for path in (dead, living):
        path.write_bytes(b'half')
    with living.open('r+b') as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        assert make().turns == {} and make().said == []
    assert not dead.exists() and living.exists()


def test_clearing_ends_it(make):
    hold(make(), stored(0))
    store = make()
    hold(store, stored(1))
    stranger = make(use=False)
    hold(stranger, stored(2))
    store.clear()
    # what it neither found nor wrote is not its own
    assert len(names(store)) == 1
    hold(store, stored(3))
    assert len(names(store)) == 1


def test_clearing_before_the_camera_is_known_removes_all_turns_and_nothing_else(make, tmp_path):
    hold(make(), stored(0))
    hold(make(Origin((640, 360))), stored(1))
    np.savez(tmp_path / 'turns' / 'mine.npz', weights=np.zeros(3))
    TurnStore(str(tmp_path / 'turns'), 10, HALF_WIDTH_S, pytest.fail).clear()
    assert [path.name for path in (tmp_path / 'turns').iterdir()] == ['mine.npz']


def test_many_writers_do_not_disturb_each_other(make):
    stores = [make(capacity=5, use=False) for _ in range(4)]

    def write(n: int) -> None:
        for step in range(5):
            hold(stores[n], *(stored(10 * n + k, 0.01 + 0.001 * (10 * n + k))
                                for k in range(step + 1)))

    threads = [threading.Thread(target=write, args=(n,)) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    found = make()
    assert found.said == [] and all(store.said == [] for store in stores)
    # they may all have seen the folder just before the others wrote, never an unreadable file
    best = sorted((turn.prominence for turn in found.turns.values()), reverse=True)
    assert best[:5] == pytest.approx([0.044, 0.043, 0.042, 0.041, 0.040])
