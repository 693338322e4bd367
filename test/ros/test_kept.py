# SPDX-License-Identifier: Apache-2.0
"""The file that the node keeps: whose it is, who else has it, and what edits make of it."""
from __future__ import annotations

import dataclasses
import os

import pytest
import yaml
from made_calibration import EACH_MODEL, calibration_of

from dashcalib_ros.errors import InputError, OutputError
from dashcalib_ros.ros.parameters import camera_name
from dashcalib_ros.ros.settings import NodeConfig
from dashcalib_ros.ros.store import CameraIdentity, Store, StoredCalibration, implausible

FRONT = CameraIdentity('front', '/front/image_raw')


@pytest.fixture
def store(tmp_path):
    """Make stores of one file; those that are still open are closed at the end."""
    made = []

    def make(whose=FRONT, path=tmp_path / 'camera.yaml'):
        made.append(Store(path, whose))
        return made[-1]

    yield make
    for each in made:
        each.close()


# that of EACH_MODEL folds over in the picture
LENSES = {**EACH_MODEL, 'brown': dataclasses.replace(EACH_MODEL['brown'], k3=0.0001)}


def kept_of(model='radial', whose=FRONT, frame_id='camera'):
    return StoredCalibration.of(calibration_of(LENSES[model]), whose, frame_id)


def edit(path, *keys, value=None):
    """Change one value of a file, as an editor would."""
    document = yaml.safe_load(path.read_text())
    block = document
    for key in keys[:-1]:
        block = block[key]
    if value is None:
        del block[keys[-1]]
    else:
        block[keys[-1]] = value
    path.write_text(yaml.safe_dump(document))


@pytest.mark.parametrize(('topic', 'name'), [
    ('/image_raw', 'dashcam'), ('/rear/image_raw', 'rear'),
    ('/camera/front/image_raw', 'camera_front'), ('/front/image_mono', 'front')])
def test_the_topic_names_the_camera(topic, name):
    assert camera_name(NodeConfig(), topic) == name
    assert camera_name(NodeConfig(camera_name='roof'), topic) == 'roof'


@pytest.mark.parametrize('model', LENSES)
def test_what_is_kept_comes_back_whole_and_says_whose_it_is(store, model):
    kept = kept_of(model)
    store().save(kept)
    document = yaml.safe_load(kept.text)
    assert (document['camera_name'], document['dashcalib']['topic'],
            document['dashcalib']['frame_id']) == ('front', '/front/image_raw', 'camera')
    first = store()
    first.close()
    found = StoredCalibration.read(kept.text, first.path, FRONT)
    assert found.camera.camera == LENSES[model] and not found.edited
    assert found.camera.sigma == kept.camera.sigma and not implausible(found.camera)
    # the user's P and the count are no edits
    other = found.rectified('crop').contradicted(2)
    again = StoredCalibration.read(other.text, first.path, FRONT)
    assert other.text != kept.text and not again.edited and again.contradictions == 2


def test_its_age_is_known_where_the_file_says_when_it_was_made():
    kept = kept_of('radial')
    assert 0 <= kept.days < 1
    for created, days in (('2020-01-01T00:00:00+00:00', 2000), ('noon', 0), (None, 0),
                          ('2020-01-01T00:00:00', 0)):
        own = {**kept.content['dashcalib'], 'created': created}
        old = dataclasses.replace(kept, content={**kept.content, 'dashcalib': own})
        assert (old.days > days) if days else (old.days == 0)


@pytest.mark.parametrize(('whose', 'code', 'value'), [
    (CameraIdentity('front', '/rear/image_raw'), 'E-KEPT-OF-OTHER-TOPIC', '/front/image_raw'),
    (CameraIdentity('rear', '/front/image_raw'), 'E-KEPT-OF-OTHER-CAMERA', 'camera front')])
def test_the_file_of_another_camera_is_neither_used_nor_lost(store, whose, code, value):
    first = store()
    first.save(kept_of())
    first.close()
    text = first.path.read_text()
    other = store(whose)
    with pytest.raises(InputError, match=value) as raised:
        other.load()
    assert raised.value.code == code
    assert first.path.read_text() == text
    said = other.save(kept_of(whose=whose))
    moved = first.path.with_name('camera.previous.yaml')
    assert said.endswith(f' {moved}')
    assert moved.read_text() == text


def test_an_older_file_without_a_topic_is_of_the_plain_topic_only(store):
    first = store()
    first.save(kept_of())
    edit(first.path, 'dashcalib', 'topic')
    edit(first.path, 'dashcalib', 'checksum')
    first.close()
    with pytest.raises(InputError) as raised:
        store(dataclasses.replace(FRONT, plain=False)).load()
    assert raised.value.code == 'E-KEPT-OF-OTHER-TOPIC'


def test_an_older_file_goes_on_for_the_plain_topic(store):
    first = store()
    first.save(kept_of())
    for key in ('topic', 'checksum', 'frame_id'):
        edit(first.path, 'dashcalib', key)
    found = first.load()
    assert found is not None and not found.edited and found.frame_id is None


def test_two_nodes_never_have_one_file(store, tmp_path):
    first = store()
    first.save(kept_of())
    second = store()
    with pytest.raises(InputError) as read:
        second.load()
    with pytest.raises(OutputError) as written:
        second.save(kept_of('brown'))
    assert read.value.code == written.value.code == 'E-KEPT-IN-USE'
    assert second.retire() == second.taken != ''
    assert first.load() is not None
    second.update(kept_of('brown'))
    assert first.load().camera.camera == LENSES['radial']
    # nor by another path
    link = tmp_path / 'link.yaml'
    link.symlink_to(first.path)
    assert store(path=link).taken
    first.close()
    assert second.load() is not None and second.taken == ''


@pytest.mark.parametrize(('keys', 'value'), [
    (('camera_matrix', 'data', 0), 20.0), (('camera_matrix', 'data', 0), 1e-9),
    (('camera_matrix', 'data', 4), 5000.0), (('camera_matrix', 'data', 2), 99999.0),
    (('camera_matrix', 'data', 5), -9999.0), (('distortion_coefficients', 'data', 0), 5.0),
    (('distortion_coefficients', 'data', 0), -5.0), (('dashcalib', 'sigma', 'fx'), 0.0),
    (('dashcalib', 'sigma', 'k1'), -1e9)])
@pytest.mark.parametrize('sealed', [True, False], ids=['', 'older'])
def test_what_no_lens_has_is_set_aside(store, keys, value, sealed):
    mine = store()
    mine.save(kept_of())
    edit(mine.path, *keys, value=value)
    if not sealed:
        edit(mine.path, 'dashcalib', 'checksum')
    with pytest.raises(InputError, match=r'camera\.previous\.yaml') as raised:
        mine.load()
    assert raised.value.code == 'E-KEPT-IMPLAUSIBLE'
    assert not mine.path.exists() and mine.path.with_name('camera.previous.yaml').exists()
    assert mine.load() is None


@pytest.mark.parametrize(('key', 'value', 'code'), [
    ('camera_name', 'rear', 'E-KEPT-OF-OTHER-CAMERA'), ('dashcalib', {}, 'E-KEPT-OF-OTHER-TOPIC'),
    ('dashcalib', None, 'E-CALIBRATION-ASPECT')])
def test_what_no_lens_has_stays_where_the_file_is_of_others(store, key, value, code):
    mine = store(dataclasses.replace(FRONT, plain=False))
    mine.save(kept_of())
    edit(mine.path, 'camera_matrix', 'data', 0, value=20.0)
    edit(mine.path, key, value=value)
    with pytest.raises(InputError) as raised:
        mine.load()
    assert raised.value.code == code and mine.path.exists()


def test_what_is_no_file_or_cannot_be_written_is_told_at_once(store, tmp_path):
    os.mkfifo(tmp_path / 'fifo')
    (tmp_path / 'folder').mkdir()
    (tmp_path / 'link').symlink_to('fifo')
    for name in ('fifo', 'folder', 'link', 'n' * 300):
        with pytest.raises(OutputError, match='camera_info_url') as raised:
            store(path=tmp_path / name)
        assert raised.value.code == 'E-KEPT-NOT-WRITABLE'
    mine = store(path=tmp_path / 'new' / 'camera.yaml')
    mine.check_writable()
    assert list(mine.path.parent.iterdir()) == []


@pytest.mark.parametrize('text', ['{{{ no yaml', ''])
def test_a_file_that_is_none_is_ignored_and_stays(store, text):
    mine = store()
    mine.path.write_text(text)
    with pytest.raises(InputError, match=r'camera\.yaml is ignored: '):
        mine.load()
    assert mine.path.read_text() == text


def test_what_was_withdrawn_is_not_loaded_again_where_it_could_not_be_moved(store, monkeypatch):
    def full(path):
        raise OutputError('E-NOT-MOVED', f'cannot move {path}')

    mine = store()
    mine.save(kept_of())
    monkeypatch.setattr('dashcalib_ros.ros.store.set_aside', full)
    with pytest.raises(OutputError):
        mine.retire()
    with pytest.raises(InputError) as raised:
        mine.load()
    assert raised.value.code == 'E-KEPT-WITHDRAWN'
    # what somebody writes there since is another one
    other = kept_of('brown')
    mine.path.write_text(other.text)
    assert mine.load().camera.camera == other.camera.camera


@pytest.mark.parametrize(('keys', 'value'), [
    (('camera_matrix', 'data', 0), 740.0), (('distortion_coefficients', 'data', 0), -0.3),
    (('dashcalib', 'sigma', 'fx'), 1e-9), (('image_height',), 376),
    (('dashcalib', 'frame_id'), 'rear'), (('dashcalib', 'checksum'), 'none')])
def test_an_edit_is_noticed_and_its_sigma_is_not_believed(store, keys, value):
    mine = store()
    mine.save(kept_of())
    assert not mine.load().edited
    edit(mine.path, *keys, value=value)
    found = mine.load()
    assert found.edited and found.camera.sigma is None
    # what the node itself writes into it later does not hide the edit
    mine.update(found.contradicted(1))
    again = mine.load()
    assert again.edited and again.contradictions == 1


def test_a_count_is_not_written_over_what_another_program_wrote(store):
    mine = store()
    mine.save(kept_of())
    kept = mine.load()
    mine.path.write_text('theirs')
    mine.update(kept.contradicted(1))
    assert mine.path.read_text() == 'theirs'
    mine.path.unlink()
    mine.update(kept.contradicted(1))
    assert not mine.path.exists()
