"""Writes config/calibrator.yaml: python -m dashcalib_ros.ros.sample > config/calibrator.yaml."""
from __future__ import annotations

import dataclasses
import textwrap
from typing import Any

import yaml

from dashcalib_ros.config import describe
from dashcalib_ros.ros.parameters import CHANGEABLE, NodeConfig

HEAD = """\
# Every parameter of the node 'calibrator' with its default. Made by dashcalib_ros.ros.sample from
# the code's own settings; keep only the lines that you change.
# Topics are remapped, not parameters: image_raw in, camera_info out.
/**:
  ros__parameters:
"""


def sample() -> str:
    """Return the file's text."""
    lines = []
    for spec in dataclasses.fields(NodeConfig):
        lines += _setting(spec.name, spec, 4)
    section = ''
    for name, spec in describe():
        outer, _, inner = name.rpartition('.')
        if outer and outer != section:
            lines.append(f'    {outer}:')
        section = outer
        lines += _setting(inner, spec, 6 if outer else 4)
    return HEAD + '\n'.join(lines) + '\n'


def _setting(name: str, spec: dataclasses.Field[Any], indent: int) -> list[str]:
    about = spec.metadata
    note = str(about['reason'])
    if about['choices']:
        note += f'; one of {", ".join(about["choices"])}'
    elif about['minimum'] is not None:
        note += f'; {about["minimum"]:g} to {about["maximum"]:g}'
    if name in CHANGEABLE:
        note += '; may be changed while the node runs'
    space = ' ' * indent
    value = yaml.safe_dump(spec.default, default_flow_style=True).split('\n')[0]
    return [*textwrap.wrap(note, 99, initial_indent=f'{space}# ', subsequent_indent=f'{space}# '),
            f'{space}{name}: {value}']


if __name__ == '__main__':
    print(sample(), end='')
