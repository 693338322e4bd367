"""report.html and the terminal's tables: what they show, and that nothing breaks out."""
from __future__ import annotations

import base64
import dataclasses
import io
import re
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest
from made_calibration import EACH_MODEL, SIGMA, TRUTH, calibration_of, make_calibration
from rich.console import Console

from dashcalib_ros.camera import Fisheye, Radial
from dashcalib_ros.report import NamedCamera, compare, report_html
from dashcalib_ros.report.figures import magnitude_svg, mask_data_uri, ticks
from dashcalib_ros.report.tables import against_truth, comparison, summary
from dashcalib_ros.solve.picture import PictureSigma

VOID = {'meta', 'img', 'br'}


class Page(HTMLParser):
    """Checks that tags nest, and collects text and addresses."""

    def __init__(self, text):
        super().__init__()
        self.open, self.text, self.links, self.tags = [], '', [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.links += [value for key, value in attrs if key in ('src', 'href', 'srcset')]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data + ' '


def terminal(renderable, **options):
    stream = io.StringIO()
    Console(file=stream, width=100, **options).print(renderable)
    return stream.getvalue()


@pytest.mark.parametrize('level', ['accepted', 'weak', 'refused'])
def test_the_page_shows_the_verdict_and_needs_nothing_else(level):
    text = report_html(make_calibration(level, warnings=('bag is cut short',)))
    page = Page(text)
    assert f'<strong>{level}</strong>' in text
    assert 'bag is cut short' in page.text
    assert ('721.54 px' in page.text) == (level != 'refused')
    assert ('only 1 of 5 turns' in page.text) == (level != 'accepted')
    assert page.links and all(link.startswith('data:') for link in page.links)
    assert 'http' not in text and 'script' not in page.tags and 'url(' not in text
    assert 'svg' in page.tags and 'turns.half_width' in page.text and '4.2.1' in page.text


@pytest.mark.parametrize('model', EACH_MODEL)
def test_every_model_s_parameters_are_shown_with_their_sigmas(model):
    lens = EACH_MODEL[model]
    calibration = calibration_of(lens, sigma_px=PictureSigma(0.412, 1.37))
    page = Page(report_html(calibration))
    assert f'{model} model, {lens.ros_model} in ROS' in page.text
    for text in (page.text, terminal(summary(calibration))):
        assert f'{model} model' in text
        assert '0.41 px over the picture, 1.37 px at the worst' in ' '.join(text.split())
        for name in lens.names():
            # a sigma of 0.0000 would be a lie
            shown = re.search(rf'\b{name}\s+(-?[\d.]+)( px)?\s+± ([\d.]+)', text)
            assert shown, name
            assert float(shown[1]) != 0 and float(shown[3]) > 0


def test_text_from_outside_is_escaped():
    evil = '<script>alert(1)</script>&"'
    calibration = make_calibration(
        'weak', input_name=evil, warnings=(evil,), versions={evil: evil}, details={evil: [evil]})
    calibration = dataclasses.replace(
        calibration, verdict=dataclasses.replace(calibration.verdict, reasons=(evil,)))
    page = Page(report_html(calibration))
    assert 'script' not in page.tags
    assert page.text.count('<script>alert(1)</script>') >= 5


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
    assert svg.count('<polyline') == 2
    assert svg.count('class="used"') == 1 and svg.count('class="unused"') == 1
    points = np.array([[float(v) for v in pair.split(',')]
                       for part in re.findall(r'points="([^"]*)"', svg)
                       for pair in part.split()])
    assert len(points) == 290 and points.min() >= 0 and points[:, 0].max() <= 900
    top = points[points[:, 1].argmin(), 0]  # the peak at 8.8 s of 29.9 s
    mark = float(re.search(r'class="used" x1="([\d.]+)"', svg).group(1))
    assert top == pytest.approx(mark, abs=3)


def test_a_long_drive_gives_a_small_plot_that_keeps_its_peaks():
    stamps = 1.7e9 + np.arange(200_000) * 0.1
    magnitude = np.full(200_000, 0.01)
    magnitude[123_456] = 0.9
    svg = magnitude_svg(np.column_stack([stamps, magnitude]), ())
    ys = [float(pair.split(',')[1]) for pair in re.findall(r'points="([^"]*)"', svg)[0].split()]
    assert len(ys) < 4 * 900
    assert sum(y < 60 for y in ys) == 1
    assert len(svg) < 60_000


@pytest.mark.parametrize('values', [[], [[0.0, 0.1]], [[0.0, np.nan], [1.0, np.nan]]])
def test_nothing_to_plot_gives_no_plot(values):
    assert magnitude_svg(np.array(values, float).reshape(-1, 2), ()) == ''


def test_equal_stamps_and_a_flat_signal_plot_too():
    assert '<polyline' in magnitude_svg(np.zeros((3, 2)), ())


@pytest.mark.parametrize(('top', 'expected'), [
    (0.06, [0, 0.02, 0.04, 0.06]), (1.0, [0, 0.5, 1.0]), (29.9, [0, 10, 20])])
def test_ticks_are_round(top, expected):
    assert ticks(top, 3) == pytest.approx(expected)


def test_the_mask_picture_is_the_mask():
    mask = np.random.default_rng(1).random((37, 91)) > 0.5
    head, data = mask_data_uri(mask).split(',')
    assert head == 'data:image/png;base64'
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), -1)
    assert np.array_equal(picture, np.where(mask, 255, 0))


def test_the_terminal_shows_estimate_sigma_verdict_and_turns():
    text = terminal(summary(make_calibration('weak')))
    lines = text.splitlines()
    assert lines[:2] == ['weak', '  only 1 of 5 turns']
    assert any(re.search(r'fx\s+721\.54 px\s+± 3\.50 px\s+0\.49 %', line) for line in lines)
    assert any(re.search(r'k1\s+-0\.3630\s+± 0\.0040\s+1\.10 %', line) for line in lines)
    assert any(re.search(r'88\s+58\s+118\s+8\.8\s+0\.0610\s+91\.5\s+30 of 31\s+0\.46\s+yes', line)
               for line in lines)
    assert '300 frames, 1 of 2 turns used' in text and '20 % masked' in text
    assert '\x1b' not in text


def test_a_refused_summary_has_no_numbers_of_a_camera():
    text = terminal(summary(make_calibration('refused')))
    assert text.startswith('refused') and 'fx' not in text


@pytest.mark.parametrize(('level', 'colour'), [('accepted', '32'), ('weak', '33'),
                                               ('refused', '31')])
def test_the_verdict_is_coloured_on_a_terminal(level, colour):
    text = terminal(summary(make_calibration(level)), force_terminal=True,
                    color_system='standard')
    assert text.startswith(f'\x1b[1;{colour}m{level}\x1b[0m')


def test_brackets_in_a_reason_are_text_and_no_markup():
    calibration = make_calibration('weak')
    verdict = dataclasses.replace(calibration.verdict, reasons=('[red]x[/] [/nonsense]',))
    assert '[red]x[/] [/nonsense]' in terminal(
        summary(dataclasses.replace(calibration, verdict=verdict)))


def test_comparisons_show_sigmas_only_where_known():
    moved = dataclasses.replace(TRUTH, fx=TRUTH.fx + 7)
    a, b = NamedCamera('mine', moved, SIGMA, 'weak'), NamedCamera('truth', TRUTH)
    text = terminal(comparison(compare(a, b)))
    assert re.search(r'fx\s+728\.54 px\s+721\.54 px\s+\+7\.0000\s+\+0\.970 %\s+2\.0', text)
    assert 'A: mine (weak)' in text and re.search(r'mapping error: \d+\.\d\d px', text)
    assert 'sigmas' not in terminal(comparison(compare(b, b)))


def test_against_truth_has_error_in_percent_and_in_sigmas():
    moved = dataclasses.replace(TRUTH, fx=TRUTH.fx + 7)
    text = terminal(against_truth(compare(NamedCamera('a', moved, SIGMA),
                                          NamedCamera('truth', TRUTH))))
    assert re.search(r'fx\s+728\.54 px\s+± 3\.50 px\s+721\.54 px\s+\+0\.970 %\s+2\.0', text)


def test_what_one_of_two_models_cannot_see_is_told():
    wide = Fisheye((1280, 720), 390.0, 391.0, 630.0, 365.0)
    pinhole = NamedCamera('pinhole', Radial((1280, 720), 390.0, 391.0, 630.0, 365.0))
    text = terminal(comparison(compare(pinhole, NamedCamera('truth', wide))))
    assert re.search(r'px, without the \d+ % of the picture that the radial model cannot', text)
    assert 'k1' not in text and 'cy' in text
    assert 'without' not in terminal(comparison(compare(NamedCamera('truth', wide), pinhole)))


def test_small_coefficients_differ_visibly():
    lens = EACH_MODEL['brown']
    moved = dataclasses.replace(lens, p1=lens.p1 + 0.00002)
    text = terminal(comparison(compare(NamedCamera('a', moved), NamedCamera('b', lens))))
    assert re.search(r'p1\s+0\.000360\s+0\.000340\s+\+0\.000020', text)


def test_an_unknown_mapping_error_is_said_to_be_unknown():
    folding = NamedCamera('f', dataclasses.replace(TRUTH, fx=300, fy=300, k1=-0.6, k2=0))
    text = terminal(comparison(compare(NamedCamera('a', TRUTH), folding)))
    assert 'mapping error: unknown' in text
