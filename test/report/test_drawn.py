# SPDX-License-Identifier: Apache-2.0
"""What the page draws: turns with their reasons, maps, plots, and lines that work when copied."""
from __future__ import annotations

import base64
import dataclasses
import html
import re
import shlex
import zlib  # noqa: F401, before pycolmap
from pathlib import Path
from urllib.parse import unquote, urlsplit

import cv2
import numpy as np
import pycolmap
import pytest
import yaml
from drawn import START_S, drawn_calibration, solution
from made_calibration import EACH_MODEL, MOUNT, calibration_of, make_calibration
from made_drives import smooth, write_folder
from page_reader import Page
from solving import CONFIG, only

from dashcalib_ros.camera.mapping import mapping_error
from dashcalib_ros.detect import TurnId
from dashcalib_ros.errors import InputError, Notice
from dashcalib_ros.input.inputs import open_frames
from dashcalib_ros.input.scale import Scale
from dashcalib_ros.judge import Verdict
from dashcalib_ros.judge.agreement import focal_of_turns, sigma_by_count
from dashcalib_ros.judge.calibration import Condition, Shutter, Stabiliser, StoredTurnSummary
from dashcalib_ros.judge.verdict import RULES, judge
from dashcalib_ros.report import NamedCamera, report_html, write_results
from dashcalib_ros.report.lens import WHY_TOGETHER, mounting_of, undistorted
from dashcalib_ros.report.turns import picture_svg
from dashcalib_ros.report.wording import conditions
from dashcalib_ros.session import with_source


@pytest.fixture(scope='module')
def drawn():
    return drawn_calibration(solution())


@pytest.fixture(scope='module')
def text(drawn):
    return report_html(drawn)


def copied(text, name):
    """Return what a click on a block selects."""
    return html.unescape(re.search(rf'<pre id="{name}"[^>]*>(.*?)</pre>', text, re.S)[1])


def test_each_turn_is_drawn_with_tracks_residuals_path_and_what_it_says_of_fx(drawn, text):
    page = Page(text)
    for kind in ('track', 'residual', 'point', 'path', 'camera'):
        assert text.count(f'<path class="{kind}"') == 3
    assert text.count('aria-label="fx by turn"') == 1  # the turns' plot would be the same
    assert text.count('class="picture"') == 5 + 1  # all five turns, and the slider's second one
    assert re.search(r'residuals magnified \d+ times', page.text)
    assert page.text.count('Alone: fx') == 3
    assert len(text) < 3_000_000
    assert all(link.startswith('data:') or f'id="{link[1:]}"' in text for link in page.links)
    assert page.links.count('#turn-by-turn') == 1


def test_the_view_in_space_is_the_scene_s(text):
    def in_space(kind):
        part = re.search(f'<path class="{kind}" data-run="\\d+" data-xyz="([^"]*)"', text)[1]
        return np.array(part.split(), float).reshape(-1, 3)

    scene = solution().scenes[0]
    structure = scene.structure
    path = in_space('path')
    centres = -np.einsum('kji,kj->ki', structure.rotations, structure.translations)
    steps, drawn = (np.linalg.norm(np.diff(each, axis=0), axis=1) for each in (centres, path))
    np.testing.assert_allclose(drawn / drawn.mean(), steps / steps.mean(), atol=0.05)
    # a camera's pyramid begins at its place on the path, and the scene is ahead of the first one
    np.testing.assert_allclose(in_space('camera').reshape(len(path), -1, 3)[:, 0], path, atol=0.11)
    assert in_space('point')[:, 1].mean() > path[0, 1]


def test_every_unused_turn_has_its_reason(drawn, text):
    assert [turn.unused_because for turn in drawn.turns] == [
        None, None, None, 'it was too dark', 'more prominent turns were enough']
    held_out = re.findall(r'data-name="held out"[^>]*>([^<]*)<', text)
    assert [each != '-' for each in held_out] == [True] * 3 + [False] * 2
    shares = re.findall(r'data-name="of fx"[^>]*>([^<]*)<', text)
    assert [each != '-' for each in shares] == [True] * 3 + [False] * 2
    assert sum(int(each[:-2]) for each in shares[:3]) == pytest.approx(100, abs=2)
    assert text.count('no: it was too dark') == text.count('not used: it was too dark') == 1


def test_a_turn_that_contradicts_the_others_says_so():
    found = solution()
    left = dataclasses.replace(only(found, range(2)),
                               misfits={**found.misfits, found.scenes[2].turn: 7.0})
    *_, contradicts, _, _ = drawn_calibration(left).turns
    assert not contradicts.used and 'does not explain it' in contradicts.unused_because
    assert '7.0 times' in contradicts.unused_because
    *_, unexplained, _, untried = drawn_calibration(None).turns
    assert 'no camera' in unexplained.unused_because
    assert 'not reconstructed' in untried.unused_because


def test_every_objection_is_a_row_that_failed_and_they_come_first(drawn):
    rows = drawn.verdict.conditions
    assert len(rows) == 8 and all(row.met and row.value and row.limit for row in rows)
    # the first objection has no number
    long = dataclasses.replace(solution(), readout_s=0.09, readout_sigma_s=0.001)
    limits = dataclasses.replace(CONFIG.verdict, max_sigma=0.001, min_turns=4)
    verdict = judge(long, limits)
    assert verdict.codes == ('E-FEW-TURNS', 'E-LARGE-SIGMA', 'E-LONG-READOUT')
    rows = verdict.conditions
    assert [row.met for row in rows] == [False] * 3 + [True] * 6
    assert tuple(row.code for row in rows[:3]) == verdict.codes
    known = f'{100 * long.sigma[0] / long.camera.fx:.2g} %'
    assert [(row.value, row.limit) for row in rows[:3]] == [
        ('3', 'at least 4'), (known, 'at most 0.1 %'), ('', '')]
    assert str(verdict.reasons[2]).startswith(rows[2].name)
    text = report_html(dataclasses.replace(drawn, verdict=verdict))
    assert text.count('<tr class="objection">') == 3 and '<code>E-LONG-READOUT</code>' in text
    assert text.index('<code>E-LONG-READOUT</code>') < text.index('rise of the error when')


def test_a_verdict_of_another_origin_has_its_reasons_as_rows(drawn):
    # the second reason has no code
    verdict = Verdict('weak', (
        Notice('E-PICTURE-BENT', 'the picture is bent', 'clean'), Notice('', 'old')))
    assert conditions(verdict) == (
        Condition('E-PICTURE-BENT', 'the picture is bent', '', '', False),
        Condition('', 'old', '', '', False))
    text = report_html(dataclasses.replace(drawn, verdict=verdict))
    assert text.count('<tr class="objection">') == 2 and '<code>E-PICTURE-BENT</code>' in text


def test_a_drive_without_turns_shows_what_it_lacks():
    verdict = drawn_calibration(None).verdict
    assert [row.code for row in verdict.conditions] == [
        verdict.codes[0], 'E-FEW-TURNS', 'E-LITTLE-YAW']
    assert not any(row.met for row in verdict.conditions) and len(verdict.codes) == 1


def test_with_two_turns_the_growth_of_what_is_known_shows_both():
    text = report_html(drawn_calibration(only(solution(), range(2))))
    style = text[text.index('<style>'):text.index('</style>')]
    plot = text[text.index('aria-label="sigma of fx over the number of turns"'):]
    dots = re.findall(r'<path class="dot (\w+)" d="([^"]+)"', plot[:plot.index('</svg>')])
    assert [outline.count('M') for _, outline in dots] == [1, 1]
    # a dot without a stroke is not seen
    assert all(re.search(rf'\.dot\.{kind} {{ stroke:', style) for kind, _ in dots)


def test_why_all_turns_know_more_than_each_alone_is_said_where_it_is_so(drawn):
    best = min(turn.sigma for turn in focal_of_turns(solution()).values())
    for part, said in ((0.6, False), (0.2, True)):
        c = dataclasses.replace(drawn, sigma={**drawn.sigma, 'fx': part * best})
        assert (WHY_TOGETHER in Page(report_html(c)).text) == said


def test_a_picture_that_is_no_keyframe_has_no_tracks(drawn):
    """The solution's scenes may have fewer keyframes than those that pictures were chosen from."""
    turn = drawn.turns[0].id
    shown = drawn.material.pictures[turn]
    other = dataclasses.replace(shown, frame=shown.frame + 1)
    text, magnified = picture_svg(other, drawn.material.scenes[turn], drawn.camera, None)
    assert 'jpeg' in text and 'class="track"' not in text and magnified == 0
    pictures = {**drawn.material.pictures, turn: other}
    assert report_html(dataclasses.replace(drawn, material=dataclasses.replace(
        drawn.material, pictures=pictures))).count('<path class="track"') == 2


def test_a_turn_that_cannot_be_drawn_costs_itself_only(drawn, monkeypatch):
    first = drawn.material.pictures[drawn.turns[0].id]

    def broken(shown, *others):
        if shown is first:
            raise ValueError('no picture')
        return picture_svg(shown, *others)
    monkeypatch.setattr('dashcalib_ros.report.turns.picture_svg', broken)
    lost = []
    text = report_html(drawn, lost=lost)
    assert [each.code for each in lost] == ['E-PART-MISSING']
    assert text.count('<path class="track"') == 2 and 'no picture' in text


def test_pictures_that_cannot_be_read_again_cost_their_colours_only(drawn, tmp_path, monkeypatch):
    source = open_frames(write_folder(tmp_path / 'drive', smooth(4)), fps=10.0)

    def gone(stamps_ns):
        raise RuntimeError('the disk is gone')
    monkeypatch.setattr(source, 'in_colour', gone)
    found = with_source(drawn, source)
    assert [each.code for each in found.warnings[len(drawn.warnings):]] == ['E-PART-MISSING']
    assert found.material == drawn.material and found.camera == drawn.camera


@pytest.mark.parametrize('part', [
    'straight_lines', '_mount', 'cross_validation', '_details', '_material'])
def test_what_fails_beside_the_camera_costs_itself_only(drawn, monkeypatch, part):
    def broken(*arguments):
        raise IndexError('list index out of range')
    monkeypatch.setattr(f'dashcalib_ros.judge.conclude.{part}', broken)
    found = drawn_calibration(solution())
    assert [each.code for each in found.warnings[len(drawn.warnings):]] == ['E-PART-MISSING']
    assert (found.camera, found.sigma, found.verdict) == (
        drawn.camera, drawn.sigma, drawn.verdict)


@pytest.mark.parametrize('count', [1, 2, 3])
@pytest.mark.parametrize('turns', [1, 9])
def test_no_row_beyond_its_limit_is_ticked(count, turns):
    """Of one turn, the largest share of one turn is 100 %."""
    config = dataclasses.replace(CONFIG.verdict, min_turns=turns)
    verdict = judge(only(solution(), range(count)), config)
    measured = [each for each in verdict.conditions if each.limit]
    assert len(measured) >= 6
    for each in measured:
        value, limit = (float(re.search(r'[-\d.]+', text)[0]) for text in (each.value, each.limit))
        within = value <= limit if 'at most' in each.limit else value >= limit
        assert each.met == within, each


def test_a_check_that_fails_makes_the_result_weak(monkeypatch):
    def broken(grounds):
        raise IndexError('list index out of range')
    monkeypatch.setattr('dashcalib_ros.judge.verdict.RULES', (*RULES, broken))
    found = drawn_calibration(solution())
    assert found.verdict.level == 'weak' and found.verdict.codes[-1] == 'E-CHECK-FAILED'


def test_where_no_report_is_wanted_nothing_is_kept_for_it():
    assert drawn_calibration(solution(), pictures=None).material is None


def test_pictures_have_the_input_s_colours(drawn, tmp_path):
    for n in range(30):
        image = np.full((90, 160, 3), (250, 120, 10 + n), np.uint8)
        cv2.imwrite(str(tmp_path / f'{n}.png'), image)
    grey = {turn: dataclasses.replace(each, stamp_ns=each.frame * 100_000_000)
            for turn, each in drawn.material.pictures.items()}
    found = with_source(dataclasses.replace(drawn, material=dataclasses.replace(
        drawn.material, pictures=grey)), open_frames(tmp_path, fps=10.0))
    for turn, each in found.material.pictures.items():
        assert each.image.shape == (*grey[turn].image.shape, 3)
        assert (each.image == (250, 120, 10 + each.frame)).all()
    data = re.search(r'jpeg;base64,([^"]*)"', report_html(found))[1]
    shown = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
    assert np.abs(shown[5, 5].astype(int) - (250, 120, 20)).max() < 25


def test_times_count_from_the_drive_s_start(drawn, text):
    assert drawn.start_s == START_S
    assert 'at 5.0 s' in Page(text).text and f'{START_S:.0f}' not in text


def test_what_turns_say_alone_scatters_about_the_common_result(drawn):
    found = solution()
    alone = focal_of_turns(found)
    assert set(alone) == {scene.turn for scene in found.scenes}
    for each in alone.values():
        assert abs(each.fx - found.camera.fx) < 5 * each.sigma
        assert 0 < each.sigma < 0.1 * found.camera.fx
    sigmas = sigma_by_count(found)
    # what the prior of the centre has drawn is in the sigma of all turns only
    assert len(sigmas) == 3 and sigmas[-1] == pytest.approx(found.sigma[0], rel=1e-4)


def test_a_refused_page_draws_the_evidence_and_has_no_camera(drawn):
    refused = dataclasses.replace(
        drawn, verdict=Verdict('refused', (Notice('', 'too little'),)), camera=None, sigma=None,
        sigma_px=None)
    text = report_html(refused)
    page = Page(text)
    assert 'class="track"' in text and 'Focal profile' in page.text
    assert 'Alone: fx' not in page.text and 'Use it' not in page.text
    assert f'{solution().camera.fx:.1f}' not in page.text and 'Parameters' not in page.text


def test_stored_turns_have_plots_and_no_picture(drawn):
    scene = dataclasses.replace(solution().scenes[0], turn=TurnId.stored(0))
    summary = StoredTurnSummary(scene.turn, 1.6e9, 0.05, 80.0, 14, False, 1.0, 'not needed')
    material = dataclasses.replace(drawn.material, scenes={scene.turn: scene}, pictures={})
    text = report_html(dataclasses.replace(drawn, turns=(), stored_turns=(summary,),
                                           material=material))
    assert 'Stored turn s1' in text and '<svg class="space"' in text and 'jpeg' not in text


def test_what_was_removed_is_told():
    text = report_html(make_calibration('weak', rolling_shutter=Shutter(20.1, 0.4),
                                        stabiliser=Stabiliser(31.0)))
    assert '20.1 ± 0.4 ms, removed' in text and 'by up to 31 px' in text


def test_the_truth_is_compared_where_it_is_known(drawn):
    moved = dataclasses.replace(drawn.camera, fx=drawn.camera.fx + 3)
    page = Page(report_html(drawn, NamedCamera('truth', moved)))
    assert 'Against the truth' in page.text and re.search(r'fx [\d.]+ px -3\.00', page.text)


# what is not known about the lens, in a program's hands

def test_sigma_at_pixels_is_about_the_map_s_and_samples_scatter_by_it(drawn):
    found = drawn.material.solution.sigma_map
    # no lens model has all that the solution does not know
    at = drawn.sigma_at(found.pixels)
    np.testing.assert_allclose(at, found.sigma, rtol=0.25)
    assert np.sqrt(np.mean(at**2)) == pytest.approx(drawn.sigma_px.rms, rel=0.03)
    one = drawn.sigma_at((10.0, 20.0))
    assert one.shape == (1,) and 0 < one[0] < 2 * drawn.sigma_px.worst
    cameras = drawn.samples(60, seed=3)
    off = [mapping_error(each, drawn.camera) for each in cameras]
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(drawn.sigma_px.rms, rel=0.3)
    assert [each.fx for each in drawn.samples(60, seed=3)] == [each.fx for each in cameras]


def test_sigma_at_pixels_is_in_those_of_the_input(drawn):
    half = drawn_calibration(solution(), scale=Scale(shrink=2), image_size=(1600, 900))
    at = drawn.material.solution.sigma_map.pixels
    np.testing.assert_allclose(half.sigma_at(2 * at + 0.5), 2 * drawn.sigma_at(at), rtol=0.01)
    assert half.samples(1)[0].image_size == (1600, 900)


def test_a_calibration_without_its_covariance_has_no_samples(drawn):
    for ask in (lambda c: c.samples(2), lambda c: c.sigma_at((0, 0))):
        with pytest.raises(InputError) as caught:
            ask(make_calibration('refused'))
        assert caught.value.code == 'E-CALIBRATION-REFUSED'
        with pytest.raises(InputError) as caught:
            ask(dataclasses.replace(drawn, picture_covariance=None))
        assert caught.value.code == 'E-UNKNOWN-COVARIANCE'


# the lines to copy

def test_the_address_is_that_of_the_file_that_is_written(tmp_path):
    folder = tmp_path / 'a folder'
    write_results(make_calibration(), folder)
    line = copied((folder / 'report.html').read_text(), 'use-ros')
    address = yaml.safe_load(line)['camera_info_url']
    assert address.startswith('file:///')
    path = Path(unquote(urlsplit(address).path))
    assert yaml.safe_load(path.read_text())['image_width'] == 1242


@pytest.mark.parametrize('model', EACH_MODEL)
def test_the_lines_for_opencv_run(model):
    calibration = calibration_of(EACH_MODEL[model])
    noise = np.random.default_rng(1).integers(0, 256, (38, 124), np.uint8)
    image = np.asarray(cv2.resize(noise, calibration.image_size, interpolation=cv2.INTER_CUBIC))
    scope = {'image': image}
    exec(copied(report_html(calibration), 'use-opencv'), scope)
    ours = calibration.undistort(image).astype(int)
    # cv2.undistort takes places to 1/32 px
    assert np.abs(ours - scope['straight']).max() <= 4 < 50 < np.abs(ours - image).max()


@pytest.mark.parametrize('model', EACH_MODEL)
def test_the_line_for_colmap_is_colmap_s(model, tmp_path):
    camera = EACH_MODEL[model]
    words = shlex.split(copied(report_html(calibration_of(camera)), 'use-colmap'))
    assert words[:2] == ['colmap', 'feature_extractor']
    options = dict(zip(words[2::2], words[3::2], strict=True))
    reader = pycolmap.ImageReaderOptions()
    for name, value in options.items():
        if name.startswith('--ImageReader.camera_'):
            setattr(reader, name.removeprefix('--ImageReader.'), value)
    (tmp_path / 'images').mkdir()
    cv2.imwrite(str(tmp_path / 'images' / 'one.png'), np.zeros((375, 1242), np.uint8))
    pycolmap.Database.open(tmp_path / 'database.db').close()
    pycolmap.import_images(tmp_path / 'database.db', tmp_path / 'images',
                           pycolmap.CameraMode.SINGLE, options=reader)
    with pycolmap.Database.open(tmp_path / 'database.db') as database:
        [found] = database.read_all_cameras()
    assert found.model.name == camera.colmap.name
    ray = np.array([0.2, -0.1, 1.0])
    np.testing.assert_allclose(found.img_from_cam(ray) - 0.5, camera.project(ray), atol=1e-3)


# the lens

def test_the_grid_is_straight_where_the_picture_is_undistorted():
    camera = EACH_MODEL['radial']
    image = np.random.default_rng(1).integers(0, 255, (375, 1242), np.uint8)
    straight, bent, ruled, moved = undistorted(image, camera, 'same')
    assert np.abs(straight.astype(int) - cv2.undistort(
        image, camera.matrix, np.array(camera.ros_distortion()))).mean() < 1.5
    assert ruled.count('L') == ruled.count('M') and bent.count('L') > 10 * ruled.count('M')
    assert moved > 50


def test_the_field_of_view_is_that_of_the_lens():
    plain = dataclasses.replace(EACH_MODEL['radial'], k1=0.0, k2=0.0, cx=620.5, cy=187.0,
                                fx=621.0, fy=187.5)
    across, down, diagonal = plain.field_of_view
    assert (across, down) == pytest.approx((90, 90)) and diagonal > 90
    assert EACH_MODEL['fisheye'].field_of_view[0] > 150


def test_a_camera_that_looks_back_is_drawn_so():
    rear = dataclasses.replace(MOUNT, yaw_left_deg=-178.0, pitch_up_deg=3.0)
    ahead, back = (mounting_of(make_calibration(mount=mount)) for mount in (MOUNT, rear))
    assert 'from which the car comes' in back[2].caption
    for seen, turned_back in zip(ahead, back, strict=True):
        assert 'comes' not in seen.svg + seen.caption and seen.svg != turned_back.svg
    assert all('where the car comes from' in drawing.svg for drawing in back[:2])
