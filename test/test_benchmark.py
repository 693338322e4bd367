# SPDX-License-Identifier: Apache-2.0
"""The benchmarks start, and their tables have a place."""
from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / 'benchmark'
if not FOLDER.is_dir():
    pytest.skip('the source distribution has no benchmarks', allow_module_level=True)
sys.path.append(str(FOLDER))
from result_tables import BEGIN, END, RESULTS, write_table  # noqa: E402 (benchmarks are no package)

SCRIPTS = sorted(path for path in FOLDER.glob('*.py')
                 if "__name__ == '__main__'" in path.read_text())
# loads what all scripts need once, and then each script as `python SCRIPT --help` does
HELP = '''
import contextlib, io, runpy, sys
sys.path.insert(0, {folder!r})
for script in sys.argv[1:]:
    printed, code = io.StringIO(), None
    sys.argv = [script, '--help']
    try:
        with contextlib.redirect_stdout(printed):
            runpy.run_path(script, run_name='__main__')
    except ModuleNotFoundError as error:
        code = 'skipped' if error.name in ('rclpy', 'matplotlib') else repr(error)
    except SystemExit as end:
        code = end.code or ('ok' if 'usage:' in printed.getvalue() else 'no usage')
    print(script, code)
'''


def test_every_script_answers_help():
    names = list(map(str, SCRIPTS))
    done = subprocess.run([sys.executable, '-c', HELP.format(folder=str(FOLDER)), *names],
                          cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    answers = dict(line.rsplit(' ', 1) for line in done.stdout.splitlines())
    assert list(answers) == names
    assert set(answers.values()) <= {'ok', 'skipped'}, done.stdout


def test_the_readme_has_every_script_and_every_table():
    text = (FOLDER / 'README.md').read_text()
    assert [path.name for path in SCRIPTS if f'`{path.name}`' not in text] == []
    assert [path.name for path in RESULTS.glob('*.md')
            if f'results/{path.name})' not in text] == []


def test_each_written_table_has_its_place():
    written = {name for path in SCRIPTS
               for name in re.findall(r"write_table\('(\w+)'", path.read_text())}
    places = {path.stem for path in RESULTS.glob('*.md') if BEGIN in path.read_text()}
    assert written == places and written
    assert all(END in (RESULTS / f'{name}.md').read_text() for name in places)


def test_a_benchmark_replaces_its_table_and_nothing_else(tmp_path):
    path = tmp_path / 'speed.md'
    path.write_text(f'before\n{BEGIN}\nold\n{END}\nafter\n')
    assert write_table('speed', '| new \\1 |\n', ['b', 'a', 'b'], tmp_path) == path
    assert re.fullmatch(rf'before\n{BEGIN}\nMeasured at a, b, on \d+ cores\.\n\n'
                        rf'\| new \\1 \|\n\n{END}\nafter\n', path.read_text())
    path.write_text('no place')
    with pytest.raises(ValueError, match='0 places'):
        write_table('speed', 'text', ['a'], tmp_path)
