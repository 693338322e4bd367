# SPDX-License-Identifier: Apache-2.0
"""What becomes of the lines in a calibration: its fields, its files, its verdict."""
from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from made_calibration import make_calibration
from made_lines import made_lines
from rich.console import Console
from solving import CONFIG, scenes_of, solved
from synthetic import LENS, SIZE

from dashcalib_ros.config import Config
from dashcalib_ros.detect import Bend
from dashcalib_ros.detect.detection import Detection
from dashcalib_ros.formats import result_dict
from dashcalib_ros.input.scale import FULL_SIZE, Scale
from dashcalib_ros.judge.conclude import Evidence, conclude
from dashcalib_ros.judge.verdict import judge
from dashcalib_ros.report.page import report_html
from dashcalib_ros.report.tables import summary

STRAIGHT = Bend(500, 12, 0.1, 0.001, 0.002, 0.001, 0.3)
BENT = Bend(500, 12, 0.4, -0.03, 0.002, 0.001, 8.0)


@pytest.fixture(scope='module')
def solution():
    return solved(scenes_of(3))


def evidence(solution, lines, scale=FULL_SIZE):
    size = (round(SIZE[0] * scale.px), round(SIZE[1] * scale.px))
    return Evidence(size, 300, (), {scene.turn: scene for scene in solution.scenes},
                    np.zeros((0, 2)), None, scale, {}, lines=lines)


@pytest.mark.parametrize('lines, level', [
    (None, 'accepted'), (STRAIGHT, 'accepted'), (BENT, 'weak'),
    # far off for the lines, but not for the solution; and too little to matter
    (replace(BENT, camera_sigma=0.01), 'accepted'), (replace(BENT, picture_px=0.2), 'accepted'),
    (replace(BENT, k1=float('nan')), 'accepted')],
    ids=['none', 'straight', 'bent', 'uncertain camera', 'harmless', 'not a number'])
def test_only_a_clear_contradiction_is_weak(solution, lines, level):
    verdict = judge(solution, CONFIG.verdict, lines)
    assert verdict.level == level
    if level == 'weak':
        assert verdict.codes == ('E-LINES-BENT',)
        assert 'k1 changed by -0.030 ± 0.002' in str(verdict.reasons[0])


def test_how_clear_it_must_be_is_a_setting(solution):
    bold = CONFIG.replace({'verdict.max_line_sigmas': 50.0})
    assert judge(solution, bold.verdict, BENT).level == 'accepted'


def test_lines_of_the_same_camera_agree_with_the_turns(solution):
    calibration = conclude(solution, evidence(solution, made_lines(LENS)), CONFIG)
    assert calibration.verdict.level == 'accepted'
    lines = calibration.straight_lines
    assert lines.sigmas < 3 and lines.camera_sigma > 0 and lines.lines > 300


def test_lines_of_another_camera_make_it_weak(solution):
    other = replace(LENS, k1=LENS.k1 + 0.08)
    calibration = conclude(solution, evidence(solution, made_lines(other)), CONFIG)
    assert calibration.verdict.level == 'weak'
    assert calibration.straight_lines.k1 == pytest.approx(0.08, abs=0.03)


def test_pixels_are_those_of_the_input(solution):
    full, half = (conclude(solution, evidence(solution, made_lines(LENS), scale),
                           CONFIG).straight_lines for scale in (FULL_SIZE, Scale(shrink=2)))
    assert half.bend_px == pytest.approx(2 * full.bend_px) and half.k1 == full.k1
    assert half.picture_px == pytest.approx(2 * full.picture_px)


def test_without_lines_nothing_is_said(solution):
    for lines in (None, made_lines(LENS, 5)):
        assert conclude(solution, evidence(solution, lines), CONFIG).straight_lines is None


def test_the_files_tell_what_lines_say():
    calibration = make_calibration(straight_lines=BENT)
    assert result_dict(calibration)['straight_lines'] == {
        'lines': 500, 'groups': 12, 'bend_px': 0.4, 'k1': -0.03, 'sigma': 0.002,
        'camera_sigma': 0.001, 'picture_px': 8.0}
    assert result_dict(make_calibration())['straight_lines'] is None
    text = '500 found, bent by 0.40 px: they would be straight with k1 changed by -0.030 ± 0.002'
    assert text in report_html(calibration)
    console = Console(width=400, record=True, file=io.StringIO())
    console.print(summary(calibration))
    assert text in console.export_text()


@pytest.fixture(scope='module')
def frames(shared_drive):
    return list(shared_drive.frames(0, 12))


def detection_of(frames):
    detection = Detection(Config())
    for frame in frames:
        detection.push(frame)
    return detection


def test_a_drive_gathers_lines_twice_a_second(frames):
    lines = detection_of(frames).lines()
    assert len(lines) > 20
    assert set(np.round((lines.stamps_s - frames[0].stamp_ns / 1e9) % 0.5, 3)) <= {0.0, 0.5}


def test_a_standing_car_gathers_none(frames):
    still = [replace(frame, image=frames[0].image) for frame in frames]
    # whether a car stands is known from the second picture on
    assert len(set(detection_of(still).lines().stamps_s)) <= 1


def test_the_own_car_is_left_out(frames):
    mask = np.zeros((360, 640), bool)
    detection = Detection(Config(), mask)
    for frame in frames:
        detection.push(frame)
    assert len(detection.lines()) == 0
