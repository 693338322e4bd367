"""Writes config/calibrator.yaml: python -m dashcalib_ros.ros.sample > config/calibrator.yaml."""
from __future__ import annotations

import dataclasses
import textwrap
from typing import Any

import yaml

from dashcalib_ros.config import describe
from dashcalib_ros.ros.settings import CHANGEABLE, NodeConfig

HEAD = """\
# Every parameter of the node 'calibrator' with its default: first those that users set, then those
# for experts. Made by dashcalib_ros.ros.sample from the code's own settings; keep only the lines
# that you change. Names with a dot, seed, threads, model, rectified, max_width and min_width are
# settings of the core, which dashcalib run --set NAME=VALUE takes, too; the others are the node's
# own. Topics are remapped, not parameters: image_raw in, camera_info out.
/**:
  ros__parameters:
"""
EXPERTS = """
    # For experts: few users need these. What was measured for them: docs/notebook/lessons.md
"""


def sample() -> str:
    """Return the file's text."""
    specs = [(spec.name, spec) for spec in dataclasses.fields(NodeConfig)] + list(describe())
    users = [_setting(*each) for each in specs if not each[1].metadata['expert']]
    experts = [_setting(*each) for each in specs if each[1].metadata['expert']]
    return HEAD + ''.join(users) + EXPERTS + ''.join(experts)


def _setting(name: str, spec: dataclasses.Field[Any]) -> str:
    about = spec.metadata
    note = str(about['reason'])
    if about['choices']:
        note += f'; one of {", ".join(about["choices"])}'
    elif about['minimum'] is not None:
        note += f'; {about["minimum"]:.10g} to {about["maximum"]:.10g}'
    if name in CHANGEABLE:
        note += '; may be changed while the node runs'
    value = yaml.safe_dump(spec.default, default_flow_style=True).split('\n')[0]
    lines = textwrap.wrap(note, 99, initial_indent='    # ', subsequent_indent='    # ')
    return '\n'.join([*lines, f'    {name}: {value}', ''])


if __name__ == '__main__':
    print(sample(), end='')
