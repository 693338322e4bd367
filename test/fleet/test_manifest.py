# SPDX-License-Identifier: Apache-2.0
"""Manifests of every kind, and bad ones: what is wrong with a row stands in the row."""
from __future__ import annotations

import json

import pytest

from dashcalib_ros.errors import ConfigError, InputError
from dashcalib_ros.fleet import manifest
from dashcalib_ros.fleet.batch import cameras_of
from dashcalib_ros.fleet.manifest import read_manifest


def rows_of(tmp_path, text, name='m.csv', **options):
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_manifest(str(path), **options)


def test_a_csv_names_clips_relative_to_itself(tmp_path):
    text = ('\ufeffClip, camera ,camera_model,fps,topic,time,notes\r\n'
            'a/1.mp4,cam,acme,12.5,/image,2026-01-31T12:00:00,"x, y"\r\n\r\n'
            '/abs/2.mp4\r\ns3://bucket/3.mp4,cam\r\n')
    one, two, three = rows_of(tmp_path, text)
    assert (one.number, one.clip, one.place) == (1, 'a/1.mp4', str(tmp_path / 'a/1.mp4'))
    assert (one.camera, one.camera_model, one.fps, one.topic) == ('cam', 'acme', 12.5, '/image')
    assert one.time_s == 1769860800.0 and not one.problem
    assert (two.number, two.place, two.camera, two.fps) == (2, '/abs/2.mp4', '', None)
    assert three.place == 's3://bucket/3.mp4'
    assert {each.name: len(each.rows) for each in cameras_of([one, two, three])} == {
        'cam': 2, '/abs/2.mp4': 1}


def test_a_rig_has_the_cameras_of_its_rows(tmp_path):
    rows = rows_of(tmp_path, 'clip,camera,rig\na.mp4,a,car 1\nb.mp4,b, car 1\nc.mp4,c,\n'
                             'd.mp4,d,car 1\nd2.mp4,d,car 2\n')
    # a camera of two cars is of none
    assert {each.name: each.rig for each in cameras_of(rows)} == {
        'a': 'car 1', 'b': 'car 1', 'c': '', 'd': ''}


def test_what_is_known_of_a_camera_stands_in_its_rows(tmp_path):
    rows = rows_of(tmp_path, 'clip,camera,known\na.mp4,a,stabiliser=no fx=1160+-20\n'
                             'b.mp4,a,"aspect=1; shutter=24 ms"\nc.mp4,a,fx=1160±20\nd.mp4,a\n'
                             'e.mp4,b,fx=900±9\nf.mp4,b,fx=700±9\ng.mp4,c,fx=9\nh.mp4,c,lens=1\n')
    first, second, _ = cameras_of(rows)
    assert first.known == {'known.stabiliser': 'no', 'known.fx': '1160±20', 'known.aspect': '1',
                           'known.shutter': '24 ms'}
    # nobody knows which of two is right
    assert second.known == {}
    assert [bool(row.problem) for row in rows] == [False] * 6 + [True] * 2


@pytest.mark.parametrize(('values', 'problem'), [
    ('a.mp4,cam,nine', 'fps must be above 0'), ('a.mp4,cam,-1', 'fps must be'),
    ('a.mp4,cam,nan', 'fps must be'), (',cam,10', 'names no clip'),
    ('a.mp4,cam,10,7', 'has 4 values for 3 columns')])
def test_a_bad_row_says_why_and_the_others_stay(tmp_path, values, problem):
    bad, good = rows_of(tmp_path, f'clip,camera,fps\n{values}\nb.mp4,cam,10\n')
    assert problem in bad.problem and not good.problem and good.number == 2


def test_bad_lines_of_json_are_rows(tmp_path):
    text = '\n'.join([json.dumps({'clip': 'a.mp4', 'fps': 10}), '{', '[1]',
                      json.dumps({'clip': 'b.mp4', 'time': 'noon'})])
    good, cut, listed, late = rows_of(tmp_path, text, 'm.jsonl')
    assert good.fps == 10 and 'JSON' in cut.problem and 'object' in listed.problem
    assert 'time' in late.problem and 'noon' in late.problem


def test_a_clip_has_a_temperature(tmp_path):
    rows = rows_of(tmp_path, 'clip;camera;temperature\na.mp4;a;-3,5\nb.mp4;a;\nc.mp4;a;293\n')
    assert [row.temperature_c for row in rows] == [-3.5, None, None]
    assert 'Celsius' in rows[2].problem and not rows[1].problem


def test_parquet(tmp_path):
    arrow = pytest.importorskip('pyarrow')
    from pyarrow import parquet
    parquet.write_table(arrow.table({'clip': ['a.mp4', None], 'fps': [10.0, None],
                                     'other': [1, 2]}), tmp_path / 'm.parquet')
    one, two = read_manifest(str(tmp_path / 'm.parquet'))
    assert one.fps == 10 and two.problem == 'names no clip'
    (tmp_path / 'bad.parquet').write_bytes(b'PAR1')
    with pytest.raises(InputError, match=r'bad\.parquet') as caught:
        read_manifest(str(tmp_path / 'bad.parquet'))
    assert caught.value.code == 'E-MANIFEST-DAMAGED'


@pytest.mark.parametrize(('data', 'code', 'where'), [
    (b'', 'E-MANIFEST-NO-CLIP-COLUMN', 'clip, camera'),
    (b'video\na.mp4\n', 'E-MANIFEST-NO-CLIP-COLUMN', 'clip, camera'),
    (b'clip\n', 'E-MANIFEST-EMPTY', ''),
    ('clip\nstraße.mp4\n'.encode('latin-1'), 'E-MANIFEST-NOT-UTF8', 'line 2'),
    ('clip\na.mp4\n'.encode('utf-16'), 'E-MANIFEST-NOT-UTF8', 'line 1'),
    (b'clip\n"' + b'x' * 200_000, 'E-MANIFEST-DAMAGED', 'line 2')])
def test_a_manifest_that_is_bad_altogether(tmp_path, data, code, where):
    with pytest.raises(InputError, match=r'm\.csv') as caught:
        rows_of(tmp_path, data)
    assert caught.value.code == code and where in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize('mark', [';', '\t'])
def test_a_spreadsheet_s_own_marks(tmp_path, mark):
    text = 'clip,camera,fps\na.mp4,cam 1,"29,97"\n'.replace(',', mark).replace(
        f'29{mark}97', '29,97')
    row, = rows_of(tmp_path, text)
    assert (row.clip, row.camera, row.fps) == ('a.mp4', 'cam 1', 29.97)


def test_a_manifest_has_only_so_many_rows(tmp_path, monkeypatch):
    monkeypatch.setattr(manifest, 'MANIFEST_ROWS', 3)
    assert len(rows_of(tmp_path, 'clip\n' + 'a.mp4\n' * 3)) == 3
    with pytest.raises(InputError, match='3 rows') as caught:
        rows_of(tmp_path, 'clip\n' + 'a.mp4\n' * 4)
    assert caught.value.code == 'E-MANIFEST-TOO-LONG'


def test_no_manifest(tmp_path):
    (tmp_path / 'empty').mkdir()
    (tmp_path / 'one.mp4').write_bytes(b'x')
    for place, code in (('gone.csv', 'E-MANIFEST-MISSING'), ('gone', 'E-MANIFEST-MISSING'),
                        ('empty', 'E-MANIFEST-EMPTY'), ('one.mp4', 'E-MANIFEST-UNKNOWN-TYPE'),
                        ('*.avi', 'E-MANIFEST-EMPTY')):
        with pytest.raises(InputError) as caught:
            read_manifest(str(tmp_path / place))
        assert caught.value.code == code


def test_folders_and_globs_in_the_order_of_their_names(tmp_path):
    for name in ('b-2.mp4', 'a-1.avi', 'notes.txt', '.hidden.mp4', 'c-3.npz'):
        (tmp_path / name).write_bytes(b'x')
    (tmp_path / 'images').mkdir()
    (tmp_path / 'images' / '0.png').write_bytes(b'x')
    found = [row.clip.removeprefix(f'{tmp_path}/') for row in read_manifest(str(tmp_path))]
    assert found == ['a-1.avi', 'b-2.mp4', 'c-3.npz', 'images']
    assert len(read_manifest(str(tmp_path / '*-*.???'))) == 3
    # images of one drive are one clip
    assert [row.place for row in read_manifest(str(tmp_path / 'images'))] == [
        str(tmp_path / 'images')]


def test_the_camera_from_the_name(tmp_path):
    text = 'clip,camera\nacme/cam7/1.mp4,\nacme/cam7/2.mp4,own\nother.mp4,\n'
    grouped = rows_of(tmp_path, text, group_by=r'(?P<camera_model>\w+)/(?P<camera>cam\d)')
    assert [(row.camera, row.camera_model) for row in grouped[:2]] == [
        ('cam7', 'acme'), ('own', 'acme')]
    assert '--group-by' in grouped[2].problem
    # and by the earlier name of the group, as of the column
    earlier = rows_of(tmp_path, text, group_by=r'(?P<make>\w+)/(?P<camera>cam\d)')
    assert earlier[0].camera_model == 'acme'
    assert rows_of(tmp_path, 'clip,make\n1.mp4,acme\n')[0].camera_model == 'acme'
    both = rows_of(tmp_path, 'clip,camera_model,make\n1.mp4,acme,\n')
    assert both[0].camera_model == 'acme'
    assert rows_of(tmp_path, text, group_by=r'cam(\d)')[0].camera == '7'
    assert rows_of(tmp_path, text, group_by=r'cam\d')[0].camera == 'cam7'
    with pytest.raises(ConfigError) as caught:
        rows_of(tmp_path, text, group_by='(')
    assert caught.value.code == 'E-GROUP-BY-INVALID'
