# SPDX-License-Identifier: Apache-2.0
"""Tables of benchmark/results/: the script that measures one writes it between two markers."""
from __future__ import annotations

import argparse
import os
import re
import subprocess
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

RESULTS = Path(__file__).parent / 'results'
BEGIN, END = '<!-- table -->', '<!-- end -->'
# what changes a measurement; a table that is written, or a page, does not
CODE = ('dashcalib_ros', 'benchmark/*.py')


def commit() -> str:
    """Return the newest commit that changed what is measured, '+' for uncommitted changes.

    '' outside a repository.
    """
    def git(*words: str) -> str:
        return subprocess.run(['git', *words, '--', *CODE], cwd=RESULTS.parents[1], check=True,
                              capture_output=True, text=True).stdout.strip()
    try:
        newest = git('log', '-1', '--format=%H')[:7]
        return newest + ('+' if git('diff', '--name-only', 'HEAD') else '')
    except (OSError, subprocess.CalledProcessError):
        return ''


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [head, ['---'] * len(head), *rows]
    return '\n'.join(f'| {" | ".join(line)} |' for line in lines)


def write_table(name: str, text: str, commits: Iterable[str], seeds: Iterable[int] = (),
                results: Path = RESULTS) -> Path:
    """Replace the table of NAME.md: with the commits it was measured at, date, machine, seeds.

    Returns the file. Raises ValueError where it has no place for the table.
    """
    path = results / f'{name}.md'
    drawn = ', '.join(map(str, seeds))
    dated = (f'Measured at {", ".join(sorted(set(commits)))}, written on '
             f'{time.strftime("%Y-%m-%d")}, {processor()}, {os.cpu_count()} cores'
             f'{f", seeds {drawn}" if drawn else ""}.')
    whole, count = re.subn(
        f'{BEGIN}.*?{END}', lambda _: f'{BEGIN}\n{dated}\n\n{text.strip()}\n\n{END}',
        path.read_text('utf-8'), flags=re.DOTALL)
    if count != 1:
        raise ValueError(f'{path} has {count} places between {BEGIN} and {END}, not one')
    path.write_text(whole, 'utf-8')
    return path


def processor() -> str:
    """Return the name of the processor, as Linux has it."""
    found = re.search(r'^(?:model name|Model|CPU part)\s*: (.*)$',
                      Path('/proc/cpuinfo').read_text(), re.MULTILINE)
    return found[1].strip() if found else os.uname().machine


def keep_table(name: str, text: str, given: argparse.Namespace, commits: Iterable[str] = (),
               seeds: Iterable[int] | None = None) -> None:
    """Print a table, keep it as OUT/NAME.md, and write it into results/ where that is asked for.

    given: the options of measure.parser_with. commits: default: this one; seeds: default: given.
    """
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / f'{name}.md').write_text(text + '\n')
    print(text)
    if given.results:
        write_table(name, text, [*commits] or [commit()],
                    getattr(given, 'seeds', ()) if seeds is None else seeds)
