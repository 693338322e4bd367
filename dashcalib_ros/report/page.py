# SPDX-License-Identifier: Apache-2.0
"""report.html and the page of two calibrations, each complete without other files."""
from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

import numpy as np

from dashcalib_ros.camera import FISHEYE, Camera
from dashcalib_ros.config import Config
from dashcalib_ros.detect.turn import MIN_PROMINENCE
from dashcalib_ros.errors import Notice, spared
from dashcalib_ros.formats import calibrated_camera
from dashcalib_ros.judge import CalibrationData
from dashcalib_ros.judge.difference import NamedCamera
from dashcalib_ros.report.charts import arrows, magnitude_svg, mask_data_uri
from dashcalib_ros.report.compare import Comparison, answers, compare, comparison_rows
from dashcalib_ros.report.lens import (
    WIDTH,
    Drawing,
    evidence_of,
    field_of,
    mounting_of,
    sigma_svg,
    slider_of,
    uncertainty_of,
)
from dashcalib_ros.report.turns import spans_of, turn_rows, turn_sections
from dashcalib_ros.report.wording import (
    ADVICE,
    FOLDER,
    conditions,
    digits_of,
    file_of,
    key_figures,
    next_steps,
    number,
    optional,
    parameter_rows,
    run_facts,
    verdict_text,
)
from dashcalib_ros.solve.spread import SigmaMap

if TYPE_CHECKING:
    import jinja2

LONGEST = 22.0  # px of the drawing; of an arrow
# the mask's element in the page; pictures refer to it
MASK_ID = 'mask'


def report_html(calibration: CalibrationData, truth: NamedCamera | None = None,
                folder: str = FOLDER, lost: list[Notice] | None = None) -> str:
    """Return the page's text; all text from the input is escaped.

    truth: to compare with, where it is known. folder: where the result is written, a path or an
    address. lost: takes a line for each part of the page that could not be made.
    """
    c, lost = calibration, [] if lost is None else lost
    mask = None if c.mask is None or c.mask.all() else c.mask
    mask_id = None if mask is None else MASK_ID
    against = None if truth is None or c.camera is None else spared(
        'the comparison with the truth', lost, compare, calibrated_camera(c), truth)
    drawn = {
        'snippets': spared('the lines to copy', lost, _snippets, c, folder),
        'uncertainty': spared('the plot of the uncertainty', lost, uncertainty_of, c),
        'slider': spared('the picture without distortion', lost, slider_of, c),
        'drive': '' if c.magnitudes is None else spared(
            'the plot of the drive', lost, magnitude_svg, c.magnitudes, c.turns,
            c.start_s or None, spans_of(c)),
        'turns': spared('the drawings of the turns', lost, turn_sections, c, mask_id, lost),
        'evidence': [*(spared('the plots of the evidence', lost, evidence_of, c, mask_id) or ()),
                     *(spared('the plot of the field', lost, field_of, c) or ())],
        'mounting': spared('the drawings of the mounting', lost, mounting_of, c)}
    settings, defaults = c.config.flat(), Config().flat()
    return template('report.html').render(
        c=c, title=f'Calibration of {c.input_name}' if c.input_name else 'Calibration',
        headline=ADVICE[c.verdict.level], figures=key_figures(c), steps=next_steps(c, folder),
        warnings=[*map(str, (*c.warnings, *lost))], **drawn,
        reasons=[each.what for each in c.verdict.reasons], shown=len(c.verdict.main_reasons),
        conditions=conditions(c.verdict),
        parameters=parameter_rows(c),
        truth=[] if against is None else _truth_rows(against),
        truth_px='' if against is None else optional(against.mapping_px, 2, ' px'),
        min_prominence=MIN_PROMINENCE, rows=turn_rows(c),
        mount_verdict='' if c.mount is None else verdict_text(c.mount),
        facts=run_facts(c),
        mask='' if mask is None else mask_data_uri(mask), mask_id=MASK_ID,
        changed={key: value for key, value in settings.items() if value != defaults[key]},
        settings=_text(settings), versions=_text(c.versions))


def difference_html(found: Comparison) -> str:
    """Return a page of two calibrations: where in the picture they differ, and beyond chance."""
    head, rows = comparison_rows(found)
    return template('compare.html').render(
        title='Two calibrations', answers=answers(found), head=head, rows=rows,
        maps=_maps(found), drawn='Over the picture', results='Parameters',
        overlines=[f'{side}: {each.name}' + (f' ({each.verdict})' if each.verdict else '')
                   for side, each in (('A', found.a), ('B', found.b))],
        note=f'For images of {found.b.image_size[0]} × {found.b.image_size[1]} px. Parameters '
             f'make up for each other: what counts is how far apart the rays are.')


def notebook_html(word: str, lines: Iterable[str], head: Sequence[str],
                  rows: Iterable[Sequence[str]]) -> str:
    """Return what a notebook shows of a result: its word, lines of text and a table."""
    return template('notebook.html').render(word=word, lines=filter(None, lines), head=head,
                                            rows=list(rows))


@lru_cache(maxsize=4)
def template(name: str) -> jinja2.Template:
    """Return a page's template."""
    # loaded here: only who writes a report needs it
    import jinja2
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader('dashcalib_ros.report'), autoescape=True, trim_blocks=True,
        lstrip_blocks=True, undefined=jinja2.StrictUndefined)
    return environment.get_template(name)


def _truth_rows(against: Comparison) -> list[tuple[str, ...]]:
    return [(d.name, number(d.name, d.b),
             '' if d.difference is None else f'{d.difference:+.{digits_of(d.name)}f}',
             '' if d.percent is None else f'{d.percent:+.2f} %', optional(d.z, 1))
            for d in against.differences]


def _text(values: Mapping[str, Any]) -> str:
    return '\n'.join(f'{key}: {value if isinstance(value, str) else json.dumps(value)}'
                     for key, value in values.items())


def _snippets(c: CalibrationData, folder: str) -> list[tuple[str, str, str]]:
    """Return how ROS drivers, OpenCV and COLMAP take the camera: an id, what for, text to copy."""
    if c.camera is None or not np.isfinite(c.camera.params).all():
        return []
    # a driver reads no file of an object store
    ros = [] if '://' in folder else [
        ('use-ros', 'ROS 2 camera driver: the parameter',
         f'camera_info_url: {Path(folder, file_of(c.verdict)).absolute().as_uri()}')]
    return [*ros, ('use-opencv', 'OpenCV in Python', _opencv(c.camera)),
            ('use-colmap', 'COLMAP', _colmap(c.camera))]


def _opencv(camera: Camera) -> str:
    fx, fy, cx, cy = (f'{value:.4f}' for value in camera.params[:4])
    distortion = ', '.join(f'{value:.8g}' for value in camera.ros_distortion())
    call = ('cv2.fisheye.undistortImage(image, K, D, Knew=K)' if camera.family == FISHEYE
            else 'cv2.undistort(image, K, D)')
    return ('import cv2\nimport numpy as np\n'
            f'K = np.array([[{fx}, 0, {cx}], [0, {fy}, {cy}], [0, 0, 1]])\n'
            f'D = np.array([{distortion}])\n'
            f'straight = {call}')


def _colmap(camera: Camera) -> str:
    values = ','.join(f'{value:.10g}' for value in camera.colmap.values(camera.params))
    return ('colmap feature_extractor --database_path database.db --image_path images '
            '--ImageReader.single_camera 1 '
            f'--ImageReader.camera_model {camera.colmap.name} '
            f'--ImageReader.camera_params {quote(values)}')


def _maps(found: Comparison) -> list[Drawing]:
    """Return maps over the picture: pixels apart, their sigma, and the ratio, as far as known."""
    whole, size = found.whole, found.b.image_size
    if whole.apart is None:
        return []
    apart, lengths = whole.apart, whole.apart.lengths
    scale = LONGEST / max(float(lengths.max()), 1e-12)
    # every other one: a chessboard of them is dense enough
    drawn = arrows(apart.pixels[::2] * WIDTH / size[0], scale * apart.offsets[::2], 'arrow')
    maps = [Drawing('Pixels apart', sigma_svg(SigmaMap(apart.pixels, lengths), size, 1.0,
                                              'pixels apart over the picture', drawn),
                    f'How far A sees a ray from where B sees it, px, the best common rotation '
                    f'removed: {apart.rms:.2f} px over the picture (RMS), {apart.worst:.2f} px at '
                    f'the worst. Arrows: from B to A, {scale * size[0] / WIDTH:.3g} times as long '
                    f'as they are.')]
    sigma = whole.sigma_map
    if sigma is None:
        return maps
    at = {tuple(pixel): value for pixel, value in zip(sigma.pixels.tolist(), sigma.sigma,
                                                       strict=True)}
    ratio = np.array([length / at.get(tuple(pixel), np.nan) for pixel, length in zip(
        apart.pixels.tolist(), lengths, strict=True)])
    known = np.isfinite(ratio)
    return [*maps, Drawing(
        'Sigma of the difference', sigma_svg(sigma, size, 1.0),
        'How far they may be apart by chance, px, one sigma of all that the files know.'),
        Drawing('In sigmas', sigma_svg(SigmaMap(apart.pixels[known], ratio[known]), size, 1.0,
                                       'sigmas apart over the picture'),
                'The first map divided by the second: where it is well above 1, the difference '
                'is more than chance.')]
