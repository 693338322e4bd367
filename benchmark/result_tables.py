# SPDX-License-Identifier: Apache-2.0
"""Tables of benchmark/results/: the benchmark that measures one writes it between two markers."""
from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path

RESULTS = Path(__file__).parent / 'results'
BEGIN, END = '<!-- table -->', '<!-- end -->'


def write_table(name: str, text: str, commits: Iterable[str], results: Path = RESULTS) -> Path:
    """Replace the table of NAME.md by this one, dated by the commits it was measured at.

    Returns the file. Raises ValueError where it has no place for the table.
    """
    path = results / f'{name}.md'
    dated = f'Measured at {", ".join(sorted(set(commits)))}, on {os.cpu_count()} cores.'
    whole, count = re.subn(
        f'{BEGIN}.*?{END}', lambda _: f'{BEGIN}\n{dated}\n\n{text.strip()}\n\n{END}',
        path.read_text('utf-8'), flags=re.DOTALL)
    if count != 1:
        raise ValueError(f'{path} has {count} places between {BEGIN} and {END}, not one')
    path.write_text(whole, 'utf-8')
    return path
