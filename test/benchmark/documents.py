"""Tables of docs/, each between two markers: the benchmark that measures one writes it."""
from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path

DOCS = Path(__file__).resolve().parents[2] / 'docs' / 'notebook'
# which document has which table
TABLES = {'accuracy': 'accuracy.md', 'attacks': 'accuracy.md', 'hostile': 'accuracy.md',
          'joined': 'accuracy.md', 'rivals': 'speed.md', 'speed': 'speed.md',
          'node_latency': 'speed.md', 'real': 'accuracy.md', 'mount': 'accuracy.md',
          'glass': 'accuracy.md'}


def write_table(name: str, text: str, commits: Iterable[str], docs: Path = DOCS) -> Path:
    """Put a table, dated by the commits it was measured at, in the place of the former one.

    Returns the document. Raises ValueError where it has no place for this table.
    """
    path = docs / TABLES[name]
    begin, end = f'<!-- table: {name} -->', f'<!-- end: {name} -->'
    dated = f'Measured at {", ".join(sorted(set(commits)))}, on {os.cpu_count()} cores.'
    whole, count = re.subn(
        f'{begin}.*?{end}', lambda _: f'{begin}\n{dated}\n\n{text.strip()}\n\n{end}',
        path.read_text('utf-8'), flags=re.DOTALL)
    if count != 1:
        raise ValueError(f'{path} has {count} places between {begin} and {end}, not one')
    path.write_text(whole, 'utf-8')
    return path
