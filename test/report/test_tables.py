# SPDX-License-Identifier: Apache-2.0
"""The terminal's tables: what they show, within 80 columns."""
from __future__ import annotations

import dataclasses
import io
import re

import numpy as np
import pytest
from made_calibration import EACH_MODEL, MOUNT, SIGMA, TRUTH, calibration_of, make_calibration
from page_reader import Page
from rich.console import Console

from dashcalib_ros.camera import Fisheye, Radial
from dashcalib_ros.camera.field import Field
from dashcalib_ros.errors import DashcalibError, Notice
from dashcalib_ros.judge import Verdict
from dashcalib_ros.judge.calibration import Known, LensField, Shutter, Stabiliser
from dashcalib_ros.report import NamedCamera, compare, report_html
from dashcalib_ros.report.tables import against_truth, comparison, conclusion, next_step, summary
from dashcalib_ros.report.wording import next_steps
from dashcalib_ros.solve.spread import PictureSigma


def terminal(renderable, width=80, **options):
    stream = io.StringIO()
    Console(file=stream, width=width, **options).print(renderable)
    return '\n'.join(line.rstrip() for line in stream.getvalue().splitlines())


def test_the_terminal_shows_estimate_sigma_and_turns():
    calibration = make_calibration('weak')
    text = terminal(summary(calibration))
    lines = text.splitlines()
    assert any(re.search(r'fx\s+721\.54 px\s+± 3\.50 px\s+0\.49 %', line) for line in lines)
    assert any(re.search(r'k1\s+-0\.3630\s+± 0\.0040\s+1\.10 %', line) for line in lines)
    assert any(re.search(r'8\.8\s+58 to 118\s+91\.5\s+30 of 31\s+0\.46\s+yes', line)
               for line in lines)
    assert 'images: 300 of 1242 × 375 px' in text and 'turns: 1 of 2 used' in text
    assert 'from one turn alone, which nothing confirms' in text
    assert 'not used: 20.0 % of the picture' in text
    assert '\x1b' not in text
    # a bag's stamps are times of day; those of turns are told from the start on
    late = [dataclasses.replace(turn, stamp_s=turn.stamp_s + 1.7e9) for turn in calibration.turns]
    assert terminal(summary(dataclasses.replace(
        calibration, turns=tuple(late), start_s=1.7e9))) == text


def test_the_terminal_says_why_turns_are_not_used():
    used, unused = make_calibration().turns
    left_out = [dataclasses.replace(unused, stamp_s=at, unused_because=why) for at, why in (
        (20.0, 'too dark'), (27.5, 'not needed'), (30.0, 'too dark'))]
    text = terminal(summary(make_calibration(turns=(used, *left_out))))
    assert 'too dark: the turns at 20.0, 30.0 s' in text and 'needed: the turn at 27.5 s' in text


def test_a_refused_summary_has_no_numbers_of_a_camera():
    assert 'fx' not in terminal(summary(make_calibration('refused')))


def test_the_conclusion_is_verdict_reasons_and_what_to_do():
    verdict = Verdict('weak', (
        Notice('', '28° of yaw in all turns; at least 60° needed', 'drive sharper turns'),
        Notice('', 'the zoom changes', 'fix the zoom'), Notice('', 'without remedy')))
    assert terminal(conclusion(verdict)).splitlines() == [
            'verdict: weak', '  28° of yaw in all turns; at least 60° needed',
            '  the zoom changes', '  without remedy']
    last = terminal(next_step(Verdict('accepted')))
    assert last.startswith('next: ') and 'calibration.yaml' in last
    assert terminal(next_step(verdict)).splitlines() == [
        'next: drive sharper turns', 'also: fix the zoom']


def test_a_refusal_is_its_cause_and_one_step():
    verdict = Verdict('refused', (
        Notice('E-DARK', 'dark', 'drive by day'), Notice('E-FEW-TURNS', 'few', 'drive'),
        Notice('E-FLAT-PROFILE', 'flat', 'drive')))
    assert terminal(conclusion(verdict)).splitlines() == ['verdict: refused', '  dark [E-DARK]']
    assert terminal(next_step(verdict)) == 'next: drive by day'
    refused = make_calibration('refused', verdict=verdict)
    text, page = report_html(refused), Page(report_html(refused))
    [step] = next_steps(refused)
    assert step.startswith('Drive by day. For the next drive: ')
    head, _, folded = text.partition('<details><summary>What follows')
    assert 'flat' in page.text and '<li>dark</li></ul>' in head and '<li>flat</li>' in folded
    for ask in (refused.accepted, lambda: refused.K, lambda: compare(refused, TRUTH)):
        with pytest.raises(DashcalibError) as caught:
            ask()
        assert 'dark' in caught.value.text and 'flat' not in caught.value.text


def test_a_reason_has_its_code():
    verdict = Verdict('weak', (Notice('E-FEW-TURNS', 'few', 'drive'), Notice('', 'no code')))
    assert terminal(conclusion(verdict)).splitlines()[1:] == ['  few [E-FEW-TURNS]', '  no code']


def test_terminal_and_page_say_what_knowledge_contributed():
    height = Known('height', 1.65, 0.02, 1.897, 0.085, True, 33.4, 12.9)
    shutter = Known('shutter', 0.03, 1e-5, 0.004, 0.002, False, 12.9, 12.9)
    calibration = make_calibration(known=(height, shutter))
    for text in (' '.join(terminal(summary(calibration)).split()),
                 ' '.join(Page(report_html(calibration)).text.split())):
        assert ('height 1.65 ± 0.02 m, the turns say 1.897 ± 0.085 m: fx is known to 13 px '
                'instead of 33') in text
        assert 'shutter 30 ± 0.01 ms, the turns say 4 ± 2 ms: it does not count' in text


def test_terminal_and_page_describe_a_mounting_alike():
    weak = Notice('E-MOUNT-LENS', 'the lens is weak')
    mount = dataclasses.replace(MOUNT, verdict='weak', reasons=(weak,), yaw_left_deg=-2.0,
                                pitch_up_deg=-1.0)
    calibration = make_calibration(mount=mount)
    shown = terminal(summary(calibration), 200), Page(report_html(calibration)).text
    for text in shown:
        assert 'weak (the lens is weak)' in text
        for angle in ('yaw 2.00 ± 0.10° to the right', 'pitch 1.00 ± 0.10° down'):
            assert angle in text.lower()
        assert '-2.00' not in text and '-1.00' not in text


def test_the_summary_says_that_a_field_is_used():
    field = LensField(Field(TRUTH.image_size, np.zeros((2, 5))), True, 0.31, 0.7, 0.2)
    text = terminal(summary(make_calibration(field=field)))
    assert 'a smooth field of 0.3 px, above its sigma of 0.2 px' in text
    assert 'field' not in terminal(summary(make_calibration()))


@pytest.mark.parametrize(('level', 'colour'), [('accepted', '32'), ('weak', '33'),
                                               ('refused', '31')])
def test_the_verdict_is_coloured_on_a_terminal(level, colour, monkeypatch):
    monkeypatch.delenv('NO_COLOR', raising=False)
    options = {'force_terminal': True, 'color_system': 'standard'}
    text = terminal(conclusion(Verdict(level)), **options)
    assert text.startswith(f'verdict: \x1b[1;{colour}m{level}\x1b[0m')
    monkeypatch.setenv('NO_COLOR', '1')
    assert f'{colour}m' not in terminal(conclusion(Verdict(level)), **options)


def test_brackets_in_a_reason_are_text_and_no_markup():
    assert '[red]x[/] [/nonsense]' in terminal(
        conclusion(Verdict('weak', (Notice('', '[red]x[/] [/nonsense]'),))))


@pytest.mark.parametrize('width', [40, 80])
@pytest.mark.parametrize('model', EACH_MODEL)
def test_nothing_is_cut_on_a_narrow_terminal(model, width):
    calibration = calibration_of(EACH_MODEL[model], sigma_px=PictureSigma(10.41, 101.37),
                                 rolling_shutter=Shutter(-20.1, 10.44),
                                 stabiliser=Stabiliser(123.4))
    long = dataclasses.replace(
        calibration.turns[0], center=1_234_567, first=1_234_500, last=1_234_600,
        stamp_s=123_456.7, yaw_deg=-123.4, images=123, registered=123,
        reprojection_error_px=10.25)
    calibration = dataclasses.replace(calibration, turns=(*calibration.turns, long),
                                      frames=1_300_000)
    lens = NamedCamera('mine', calibration.camera, calibration.sigma, 'accepted')
    other = NamedCamera('truth', dataclasses.replace(calibration.camera, fx=1234.5))
    for shown in (summary(calibration), comparison(compare(lens, other)),
                  against_truth(compare(lens, other))):
        text = terminal(shown, width)
        assert '…' not in text and max(map(len, text.splitlines())) <= width
    text = terminal(summary(calibration), width)
    assert '1234500 to 1234600' in text
    assert all(f' {title}' in text for title in ('relative', 'error px', 'used', 'yaw °'))
    assert text.count('at s') == (1 if width == 80 else 2)


def test_comparisons_show_sigmas_only_where_known():
    moved = dataclasses.replace(TRUTH, fx=TRUTH.fx + 7)
    a, b = NamedCamera('mine', moved, SIGMA, 'weak'), NamedCamera('truth', TRUTH)
    text = terminal(comparison(compare(a, b)))
    assert re.search(r'fx\s+728\.54 px\s+721\.54 px\s+\+7\.0000\s+\+0\.970 %\s+2\.0', text)
    assert 'A: mine (weak)' in text and re.search(r'differs by \d+\.\d\d px RMS', text)
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
    assert re.search(r'removed; without the\s\d+\s% of the picture that the\sradial\smodel\s'
                     r'cannot', text)
    assert 'k1 (fisheye)' in text and 'k1 (radial)' in text
    assert 'without' not in terminal(comparison(compare(NamedCamera('truth', wide), pinhole)))


def test_small_coefficients_differ_visibly():
    lens = EACH_MODEL['brown']
    moved = dataclasses.replace(lens, p1=lens.p1 + 0.00002)
    text = terminal(comparison(compare(NamedCamera('a', moved), NamedCamera('b', lens))))
    assert re.search(r'p1\s+0\.000360\s+0\.000340\s+\+0\.000020', text)


def test_an_unknown_mapping_error_is_said_to_be_unknown():
    folding = NamedCamera('f', dataclasses.replace(TRUTH, fx=300, fy=300, k1=-0.6, k2=0))
    text = terminal(comparison(compare(NamedCamera('a', TRUTH), folding)))
    assert 'answer: wrong' in text and 'not comparable' in text
