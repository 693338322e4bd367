# SPDX-License-Identifier: Apache-2.0
"""The example notebook, run from its first cell to its last."""
from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest

nbformat = pytest.importorskip('nbformat', reason='no notebooks here: pip install the test extra')
nbclient = pytest.importorskip('nbclient', reason='no notebooks here: pip install the test extra')
pytest.importorskip('ipykernel', reason='no notebooks here: pip install the test extra')
pytest.importorskip('matplotlib', reason='no plots here: pip install the test extra')

ROOT = Path(__file__).parents[1]
NOTEBOOK = ROOT / 'examples' / 'calibrate.ipynb'


def outputs_of(cell):
    """Return what a cell printed or returned, as one text."""
    return ''.join(each.get('text', '') or each.get('data', {}).get('text/plain', '')
                   for each in cell.outputs)


@pytest.fixture
def kernels(tmp_path, monkeypatch):
    """Let the kernel be this Python, with the sources of this clone, wherever others are."""
    spec = tmp_path / 'kernels' / 'python3'
    spec.mkdir(parents=True)
    (spec / 'kernel.json').write_text(json.dumps({
        'argv': [sys.executable, '-m', 'ipykernel_launcher', '-f', '{connection_file}'],
        'display_name': 'Python 3', 'language': 'python'}))
    monkeypatch.setenv('JUPYTER_PATH', str(tmp_path))
    monkeypatch.setenv('JUPYTER_RUNTIME_DIR', str(tmp_path / 'runtime'))
    monkeypatch.setenv('IPYTHONDIR', str(tmp_path / 'ipython'))
    monkeypatch.setenv('TMPDIR', str(tmp_path))
    monkeypatch.setenv('PYTHONPATH', os.pathsep.join([str(ROOT), *filter(None, [
        os.environ.get('PYTHONPATH')])]))


@pytest.mark.thorough
def test_the_notebook_runs(kernels, tmp_path):
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbclient.NotebookClient(notebook, timeout=600, kernel_name='python3',
                            resources={'metadata': {'path': str(tmp_path)}}).execute()
    assert_complete(notebook)


def assert_complete(notebook):
    """Assert that each cell said what the text around it promises."""
    code = [cell for cell in notebook.cells if cell.cell_type == 'code']
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    said = [outputs_of(cell) for cell in code]
    assert said[1].startswith('Calibration(accepted, radial, fx ')
    sigmas = [float(line.rsplit(', ', 1)[1].split()[0]) for line in said[3].splitlines()
              if line.startswith(('fx', 'fy', 'cx', 'cy', 'k1', 'k2'))]
    assert len(sigmas) == 6 and max(map(abs, sigmas)) < 3
    assert any('image/png' in each.get('data', {}) for each in code[4].outputs)
    assert said[5].split() == ['calibration.yaml', 'result.json', 'report.html']


def test_it_is_stored_with_its_outputs():
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(notebook)
    assert_complete(notebook)
    text = ''.join(outputs_of(cell) for cell in notebook.cells if cell.cell_type == 'code')
    # nothing of the machine it ran on, and little for each clone to carry
    assert not any(f'/{folder}/' in text for folder in ('home', 'root', 'tmp', 'work'))
    assert all(each.output_type != 'error' and each.get('name') != 'stderr'
               for cell in notebook.cells for each in cell.get('outputs', ()))
    assert NOTEBOOK.stat().st_size < 400_000
