# SPDX-License-Identifier: Apache-2.0
"""The benchmarks start, and their tables have a place."""
from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from dashcalib_ros.demo import demo_drive
from dashcalib_ros.errors import InputError

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / 'benchmark'
if not FOLDER.is_dir():
    pytest.skip('the source distribution has no benchmarks', allow_module_level=True)
sys.path.append(str(FOLDER))
from result_tables import BEGIN, END, RESULTS, write_table  # noqa: E402 (benchmarks are no package)

SCRIPTS = sorted(path for path in FOLDER.rglob('[!_]*.py')
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
    assert [path.name for path in SCRIPTS
            if f'`{path.name}`' not in text and f'`{path.stem}`' not in text] == []
    assert [path.name for path in RESULTS.glob('*.md')
            if f'results/{path.name})' not in text] == []


def test_each_table_is_written_by_its_script():
    for path in RESULTS.glob('*.md'):
        text = path.read_text()
        assert text.count(BEGIN) == text.count(END) == 1, path
        assert f"keep_table('{path.stem}'" in (FOLDER / f'{path.stem}.py').read_text(), path
        assert re.search(rf'{BEGIN}\nMeasured at ', text), path


def test_a_benchmark_replaces_its_table_and_nothing_else(tmp_path):
    path = tmp_path / 'speed.md'
    path.write_text(f'before\n{BEGIN}\nold\n{END}\nafter\n')
    assert write_table('speed', '| new \\1 |\n', ['b', 'a', 'b'], [1, 2], tmp_path) == path
    assert re.fullmatch(rf'before\n{BEGIN}\nMeasured at a, b, written on \d{{4}}-\d\d-\d\d, .+, '
                        rf'\d+ cores, seeds 1, 2\.\n\n'
                        rf'\| new \\1 \|\n\n{END}\nafter\n', path.read_text())
    path.write_text('no place')
    with pytest.raises(ValueError, match='0 places'):
        write_table('speed', 'text', ['a'], results=tmp_path)


@pytest.mark.thorough
def test_the_runner_keeps_what_is_done_at_a_commit(tmp_path):
    """A part that is done is not begun again; one that failed is; another commit begins anew."""
    made = tmp_path / 'repository'
    (made / 'benchmark' / 'results').mkdir(parents=True)
    for name in ('__main__', 'measure', 'mapping', 'result_tables', 'figures'):
        shutil.copy(FOLDER / f'{name}.py', made / 'benchmark')
    (made / 'benchmark' / 'size.py').write_text(
        'import sys\nfrom measure import parser_with\n'
        "given = parser_with(__doc__, 'seeds', 'again').parse_args()\n"
        "with open('began', 'a') as file:\n    file.write(f'{given.seeds}\\n')\n"
        'sys.exit(given.seeds == [9])\n')
    (made / '.gitignore').write_text('__pycache__/\nmeasured/\nbegan\n')

    def git(*words):
        subprocess.run(['git', '-c', 'user.name=a', '-c', 'user.email=a@b', *words], cwd=made,
                       check=True, capture_output=True)

    def run(*words):
        return subprocess.run([sys.executable, '-m', 'benchmark', 'size', *words], cwd=made,
                              capture_output=True, text=True)

    git('init')
    git('add', '.')
    git('commit', '-m', 'first')
    assert [run('--seeds', *seeds).returncode for seeds in (['1-3'], ['1-3'], ['9'], ['9'])] == [
        0, 0, 1, 1]
    assert (made / 'began').read_text() == '[1, 2, 3]\n[9]\n[9]\n'
    (made / 'page.md').write_text('a page changes no measurement')
    git('add', '.')
    git('commit', '-m', 'page')
    assert run('--seeds', '1-3').returncode == 0
    with (made / 'benchmark' / 'size.py').open('a') as file:
        file.write('# changed\n')
    assert 'commit your changes' in run('--seeds', '1-3').stderr
    git('commit', '-am', 'second')
    assert run('--seeds', '1-3').returncode == 0
    assert (made / 'began').read_text().count('[1, 2, 3]') == 2


def test_the_public_benchmark_scores_camera_files(tmp_path, capsys, monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER / 'public'))
    import score
    good, blind = tmp_path / 'good', tmp_path / 'blind'
    good.mkdir()
    blind.mkdir()
    for lens in ('radial', 'fisheye', 'straight'):
        drive = demo_drive(0, lens)
        truth = {'model': drive.lens.model, **drive.truth, 'width': 960, 'height': 540}
        sigma = {key: 0.01 * abs(value) for key, value in drive.truth.items()}
        # one that is as right as it says, and a file that says nothing of itself
        off = {'fx': 1.005 * truth['fx'], 'fy': 1.005 * truth['fy']}
        if lens != 'straight':
            (good / f'{lens}-0.json').write_text(json.dumps({**truth, **off, 'sigma': sigma}))
        (blind / f'{lens}-0.json').write_text(json.dumps({**truth, 'fx': 1.02 * truth['fx']}))
    (good / 'kitti03.json').write_text(json.dumps({
        'fx': 718.2, 'fy': 718.2, 'cx': 609.5, 'cy': 172.8, 'k1': 0.0, 'k2': 0.0, 'width': 1242,
        'height': 375}))
    monkeypatch.setattr(sys, 'argv', ['score.py', str(good), str(blind), '--seeds', '0'])
    score.main()
    rows = [[cell.strip() for cell in line.split('|')[1:-1]]
            for line in capsys.readouterr().out.splitlines()]
    assert rows[2][:5] == ['good', '3 of 8', '2 of 2', '0.50', '0.50']
    assert 0.5 < float(rows[2][6]) < 4.0
    assert rows[3][:5] == ['blind', '2 of 8', '1 of 2', '2.00', '2.00']
    assert rows[3][7:] == ['none said', 'none said']
    scores = [score.score(known, score.camera_in(good, known.name))
              for known in score.drives([0])]
    exact = next(each for each in scores if each.known.name == 'kitti03')
    assert exact.off_percent == 0.0 and exact.rays_px is None
    (good / 'radial-0.yaml').write_text('')
    with pytest.raises(InputError, match='radial-0'):
        score.camera_in(good, 'radial-0')
