# SPDX-License-Identifier: Apache-2.0
"""report.html: what it shows, and that nothing breaks out."""
from __future__ import annotations

import base64
import dataclasses
import io
import re

import cv2
import numpy as np
import pytest
from made_calibration import EACH_MODEL, MOUNT, calibration_of, make_calibration
from page_reader import Page
from rich.console import Console

from dashcalib_ros.camera.field import Field
from dashcalib_ros.config import Config
from dashcalib_ros.errors import Notice
from dashcalib_ros.judge.calibration import LensField
from dashcalib_ros.judge.verdict import verdict_of, yaw_in_all
from dashcalib_ros.report import report_html
from dashcalib_ros.report.charts import log_ticks, magnitude_svg, mask_data_uri, ticks
from dashcalib_ros.report.tables import summary
from dashcalib_ros.report.wording import next_steps
from dashcalib_ros.solve.spread import PictureSigma


def terminal(renderable, **options):
    stream = io.StringIO()
    Console(file=stream, width=100, **options).print(renderable)
    return stream.getvalue()


@pytest.mark.parametrize('level', ['accepted', 'weak', 'refused'])
def test_the_page_shows_the_verdict_and_needs_nothing_else(level):
    text = report_html(make_calibration(level, warnings=(Notice('', 'bag is cut short'),)))
    page = Page(text)
    assert f'<strong>{level}</strong>' in text
    assert 'bag is cut short' in page.text
    assert ('721.54 px' in page.text) == (level != 'refused')
    assert ('only 1 of 5 turns' in page.text) == (level != 'accepted')
    assert ('from one turn alone' in page.text) == (level != 'refused')
    assert page.links and all(link.startswith(('data:', '#')) for link in page.links)
    # its one script is in it
    assert 'http' not in text and page.tags.count('script') == 1 and 'url(' not in text
    assert 'svg' in page.tags and 'turns.half_width' in page.text and '4.2.1' in page.text


@pytest.mark.parametrize('model', EACH_MODEL)
def test_every_model_s_parameters_are_shown_with_their_sigmas(model):
    lens = EACH_MODEL[model]
    calibration = calibration_of(lens, sigma_px=PictureSigma(0.412, 1.37))
    page = Page(report_html(calibration))
    assert f'{model} model, {lens.ros_model} in ROS' in page.text
    for text in (page.text, terminal(summary(calibration))):
        assert model in text
        assert re.search(r'0\.41 px .{,25}1\.37 px at the worst', ' '.join(text.split()))
        for name in lens.names():
            # a sigma of 0.0000 would be a lie
            shown = re.search(rf'\b{name}\s+(-?[\d.]+)( px)?\s+± ([\d.]+)', text)
            assert shown, name
            assert float(shown[1]) != 0 and float(shown[3]) > 0


def test_text_from_outside_is_escaped():
    evil = '<script>alert(1)</script>&"'
    calibration = make_calibration(
        'weak', input_name=evil, warnings=(Notice('', evil),), versions={evil: evil})
    calibration = dataclasses.replace(
        calibration, verdict=dataclasses.replace(calibration.verdict, reasons=(Notice('', evil),)))
    page = Page(report_html(calibration))
    assert page.tags.count('script') == 1
    assert page.text.count('<script>alert(1)</script>') >= 4


def test_a_calibration_that_knows_little_has_a_page(recwarn):
    calibration = make_calibration(
        'refused', turns=(), magnitudes=None, mask=None, reprojection_error_px=None, timing={},
        versions={}, input_name='')
    page = Page(report_html(calibration))
    assert 'svg' not in page.tags and 'img' not in page.tags
    assert len(recwarn) == 0


def test_the_plot_marks_turns_and_leaves_gaps():
    calibration = make_calibration()
    magnitudes = calibration.magnitudes.copy()
    magnitudes[150:160, 1] = np.nan
    svg = magnitude_svg(magnitudes, calibration.turns)
    [signal] = re.findall(r'class="signal" d="([^"]*)"', svg)
    assert signal.count('M') == 2
    assert svg.count('class="used"') == 1 and svg.count('class="unused"') == 1
    assert re.findall(r'number \w+-text"[^>]*>(\d+)<', svg) == ['1', '2']
    points = np.array(re.split('[ML ]', signal)[1:], float).reshape(-1, 2)
    assert len(points) == 290 and points.min() >= 0 and points[:, 0].max() <= 900
    top = points[points[:, 1].argmin(), 0]  # the peak at 8.8 s of 29.9 s
    mark = float(re.search(r'class="used" x1="([\d.]+)"', svg).group(1))
    assert top == pytest.approx(mark, abs=3)


def test_a_long_drive_gives_a_small_plot_that_keeps_its_peaks():
    stamps = 1.7e9 + np.arange(200_000) * 0.1
    magnitude = np.full(200_000, 0.01)
    magnitude[123_456] = 0.9
    svg = magnitude_svg(np.column_stack([stamps, magnitude]), ())
    [signal] = re.findall(r'class="signal" d="M([^"M]*)"', svg)
    ys = [float(point.split()[1]) for point in signal.split('L')]
    assert len(ys) < 4 * 900
    assert sum(y < 60 for y in ys) == 1
    assert len(svg) < 60_000


@pytest.mark.parametrize('values', [[], [[0.0, 0.1]], [[0.0, np.nan], [1.0, np.nan]]])
def test_nothing_to_plot_gives_no_plot(values):
    assert magnitude_svg(np.array(values, float).reshape(-1, 2), ()) == ''


def test_what_counts_is_a_bar_as_high_as_its_share():
    magnitudes = np.column_stack([np.arange(100.0, 120.0), np.linspace(0, 0.01, 20)])
    svg = magnitude_svg(magnitudes, (), None, [(100.0, 106.0, 0.25), (110.0, 116.0, 0.5)])
    bars = [[float(value) for value in found] for found in re.findall(
        r'class="band" x="([^"]*)" y="[^"]*" width="([^"]*)" height="([^"]*)"', svg)]
    assert bars[1][2] == pytest.approx(2 * bars[0][2], abs=0.2) and bars[1][0] > bars[0][0]
    assert bars[0][1] == pytest.approx(bars[1][1], abs=0.2)


def test_equal_stamps_and_a_flat_signal_plot_too():
    assert 'class="signal" d="M' in magnitude_svg(np.zeros((3, 2)), ())


@pytest.mark.parametrize(('low', 'high', 'expected'), [
    (0, 0.06, [0, 0.02, 0.04, 0.06]), (0, 1.0, [0, 0.5, 1.0]), (0, 29.9, [0, 10, 20]),
    (-13, 21, [0, 20]), (5, 5, [5])])
def test_ticks_are_round(low, high, expected):
    assert ticks(low, high, 3) == pytest.approx(expected)


@pytest.mark.parametrize(('low', 'high', 'expected'), [
    (290, 1100, [300, 400, 500, 600, 800, 1000]), (0.04, 0.6, [0.05, 0.1, 0.2, 0.5]),
    (0.5, 2000, [1, 10, 100, 1000])])
def test_ticks_of_a_logarithmic_axis_are_round(low, high, expected):
    assert log_ticks(low, high) == pytest.approx(expected)


def test_a_drive_that_has_no_mask_shows_none():
    whole = np.ones((375, 1242), bool)
    page = Page(report_html(make_calibration(mask=whole)))
    assert 'moves with the car (' not in page.text and '#mask' not in page.links
    assert '20.0 % of the picture' in Page(report_html(make_calibration())).text


def test_settings_are_folded_away():
    assert re.search(r'<details><summary>All settings</summary><pre>.*turns.wanted: 5\n',
                     report_html(make_calibration()), re.S)


def test_settings_that_were_changed_are_named():
    text = report_html(make_calibration(config=Config().replace({'turns.wanted': 3})))
    assert '<code>turns.wanted=3</code>' in text and '<code>turns.half' not in text


def test_the_steps_name_the_folder_and_what_this_camera_needs():
    lens = make_calibration()
    text = ' '.join(next_steps(lens, 'my drives/a'))
    assert "`'my drives/a/calibration.yaml'`" in text and "check 'my drives/a' DRIVE" in text
    assert 'mounting' not in text and 'undistort' not in text
    field = LensField(Field(lens.image_size, np.zeros((2, 5))), True, 2.0, 4.0, 0.5)
    text = ' '.join(next_steps(make_calibration(mount=MOUNT, field=field), 'a'))
    assert 'the mounting only' in text and ".load('a').undistort(image)" in text
    assert 'a/calibration.weak.yaml' in ' '.join(next_steps(make_calibration('weak'), 'a'))


def test_a_result_in_an_object_store_has_no_line_for_a_driver():
    text = report_html(make_calibration(), folder='s3://bucket/cam')
    assert 's3://bucket/cam/calibration.yaml' in text and 'id="use-ros"' not in text


@pytest.mark.parametrize('level', ['weak', 'refused'])
def test_what_is_missing_is_told_in_numbers(level):
    missing = dataclasses.replace(yaw_in_all(0.0, Config().verdict), level=level)
    text = Page(report_html(make_calibration(
        level, turns=make_calibration().turns[1:], verdict=verdict_of([missing])))).text
    assert missing.what in text
    assert 'this drive has 0 and 0°' in text
    assert re.search(r'yaw of these turns together\s+E-LITTLE-YAW\s+0°\s+at least 60°\s+✗', text)


def test_the_mask_s_tint_is_the_mask():
    mask = np.random.default_rng(1).random((37, 91)) > 0.5
    head, data = mask_data_uri(mask).split(',')
    assert head == 'data:image/png;base64'
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), -1)
    assert np.array_equal(picture[..., 3] > 0, ~mask)
