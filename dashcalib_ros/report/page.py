"""report.html: the calibration on one page, without references to other files."""
from __future__ import annotations

import json
from collections.abc import Mapping
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dashcalib_ros.config import Config
from dashcalib_ros.judge import Calibration
from dashcalib_ros.report.checks import checks
from dashcalib_ros.report.compare import compare
from dashcalib_ros.report.figures import magnitude_svg, mask_data_uri
from dashcalib_ros.report.lens_sections import evidence_of, lens_of
from dashcalib_ros.report.named_camera import NamedCamera, calibrated_camera
from dashcalib_ros.report.turn_sections import turn_rows, turn_sections
from dashcalib_ros.report.usage import field_of_view, snippets
from dashcalib_ros.report.wording import (
    ADVICE,
    digits_of,
    key_figures,
    next_steps,
    number,
    optional,
    parameter_rows,
    removed_effects,
    run_facts,
)

if TYPE_CHECKING:
    import jinja2

# the mask's element in the page; pictures refer to it
MASK_ID = 'mask'


def report_html(calibration: Calibration, truth: NamedCamera | None = None,
                calibration_file: Path | None = None) -> str:
    """Return the page's text; all text from the input is escaped.

    truth: to compare with, where it is known. calibration_file: where the camera is written.
    """
    c = calibration
    mask = c.mask is not None and not bool(c.mask.all())
    mask_id = MASK_ID if mask else None
    return template('report.html').render(
        c=c, title=f'Calibration of {c.input_name}' if c.input_name else 'Calibration',
        headline=ADVICE[c.verdict.level], figures=key_figures(c, _field_of_view(c)),
        steps=next_steps(c), checks=checks(c), parameters=parameter_rows(c),
        removed=removed_effects(c),
        truth=_truth_rows(c, truth), truth_px=_truth_px(c, truth),
        snippets=_snippets(c, calibration_file), lens=lens_of(c),
        drive=_drive(c), turns=turn_sections(c, mask_id), rows=turn_rows(c),
        evidence=evidence_of(c, mask_id), facts=run_facts(c),
        mask=mask_data_uri(c.mask) if mask and c.mask is not None else '', mask_id=MASK_ID,
        masked=0.0 if c.mask is None else 100 * (1 - float(np.mean(c.mask))),
        changed=_changed(c.config), settings=_text(c.config.flat()), versions=_text(c.versions))


def page_style() -> str:
    """Return the style sheet of the report, for other pages of the same look."""
    folder = resources.files('dashcalib_ros.report')
    return folder.joinpath('templates/style.css').read_text('utf-8')


@lru_cache(maxsize=2)
def template(name: str) -> jinja2.Template:
    """Return a page's template."""
    # loaded here: only who writes a report needs it
    import jinja2
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader('dashcalib_ros.report'), autoescape=True, trim_blocks=True,
        lstrip_blocks=True, undefined=jinja2.StrictUndefined)
    return environment.get_template(name)


def _field_of_view(c: Calibration) -> Any:
    return None if c.camera is None else field_of_view(c.camera)


def _drive(c: Calibration) -> str:
    if c.magnitudes is None:
        return ''
    return magnitude_svg(c.magnitudes, c.turns, c.start_s if c.start_s else None)


def _snippets(c: Calibration, path: Path | None) -> Any:
    if c.camera is None or not np.isfinite(c.camera.params).all():
        return ()
    name = 'calibration.yaml' if c.verdict.level == 'accepted' else 'calibration.weak.yaml'
    return snippets(c.camera, (path or Path(name)).absolute())


def _truth_rows(c: Calibration, truth: NamedCamera | None) -> list[tuple[str, ...]]:
    if truth is None or c.camera is None:
        return []
    return [(d.name, number(d.name, d.b),
             f'{d.difference:+.{digits_of(d.name)}f}',
             '' if d.percent is None else f'{d.percent:+.2f} %', optional(d.z, 1))
            for d in compare(calibrated_camera(c), truth).differences]


def _truth_px(c: Calibration, truth: NamedCamera | None) -> str:
    if truth is None or c.camera is None:
        return ''
    return optional(compare(calibrated_camera(c), truth).mapping_px, 2, ' px')


def _changed(config: Config) -> dict[str, Any]:
    """Return the settings that are not the defaults."""
    defaults = Config().flat()
    return {key: value for key, value in config.flat().items() if value != defaults[key]}


def _text(values: Mapping[str, Any]) -> str:
    return '\n'.join(f'{key}: {value if isinstance(value, str) else json.dumps(value)}'
                     for key, value in values.items())
