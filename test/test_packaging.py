# SPDX-License-Identifier: Apache-2.0
"""What the source distribution and the wheel hold, and the Dockerfile takes."""
from __future__ import annotations

import ast
import fnmatch
import json
import os
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml
from made_drives import drive, write_folder

pytest.importorskip('setuptools')

ROOT = Path(__file__).parents[1]
BUILD = ('import sys; from setuptools import build_meta; '
         'getattr(build_meta, sys.argv[1])(sys.argv[2])')


def setup_keyword(name):
    """Return a literal that setup.py gives to setup()."""
    tree = ast.parse((ROOT / 'setup.py').read_text())
    found, = (keyword.value for node in ast.walk(tree) if isinstance(node, ast.Call)
              for keyword in node.keywords if keyword.arg == name)
    return ast.literal_eval(found)


def build(source, kind, out):
    """Build in a folder as pip does, without installing anything for it."""
    out.mkdir()
    done = subprocess.run([sys.executable, '-c', BUILD, f'build_{kind}', str(out)], cwd=source,
                          capture_output=True, text=True, timeout=120)
    if 'bdist_wheel' in done.stderr and 'invalid command' in done.stderr:
        pytest.skip('this setuptools needs the package wheel to build wheels')
    assert done.returncode == 0, done.stdout + done.stderr
    file, = out.iterdir()
    return file


def tracked_files():
    """Return what a clone has; without git, whatever is here."""
    done = subprocess.run(['git', 'ls-files'], cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        pytest.skip('no git clone here')
    return [name for name in done.stdout.splitlines() if (ROOT / name).is_file()]


@pytest.fixture(scope='module')
def unpacked(tmp_path_factory):
    """Return the source distribution of a clean clone, unpacked."""
    place = tmp_path_factory.mktemp('packaging')
    clone = place / 'clone'
    for name in tracked_files():
        (clone / name).parent.mkdir(parents=True, exist_ok=True)
        (clone / name).write_bytes((ROOT / name).read_bytes())
    archive = build(clone, 'sdist', place / 'sdist')
    with tarfile.open(archive) as file:
        names = file.getnames()
        file.extractall(place, **({'filter': 'data'} if sys.version_info >= (3, 12) else {}))
    return place / names[0].split('/')[0]


def test_the_source_distribution_has_what_a_clone_has(unpacked):
    inside = {str(path.relative_to(unpacked)) for path in unpacked.rglob('*')}
    dropped = ('.ci', '.github', '.gitignore', '.pre-commit-config.yaml', '.dockerignore',
               'MANIFEST.in', 'benchmark/')
    missing = {name for name in tracked_files() if not name.startswith(dropped)} - inside
    assert missing == set(), 'add them to MANIFEST.in'
    assert not (unpacked / 'benchmark').exists()


@pytest.fixture(scope='module')
def wheel(unpacked, tmp_path_factory):
    """Return the wheel, built from the source distribution."""
    return build(unpacked, 'wheel', tmp_path_factory.mktemp('wheel') / 'dist')


def test_the_wheel_of_the_source_distribution_is_complete(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    share = f'{wheel.name.split("-py3")[0]}.data/data/share'
    expected = {name for name in tracked_files() if name.startswith('dashcalib_ros/')}
    expected |= {f'{share}/dashcalib_ros/{name}' for name in tracked_files()
                 if name.startswith(('config/', 'launch/')) or name == 'package.xml'}
    expected |= {f'{share.removesuffix("share")}lib/dashcalib_ros/{name}'
                 for name in ('calibrator', 'checker', 'rig')}
    expected.add(f'{share}/ament_index/resource_index/packages/dashcalib_ros')
    assert expected - set(names) == set()
    # neither tests nor documents become somebody's top-level package
    assert {name.split('/')[0].split('-')[0] for name in names} == {'dashcalib_ros'}


def test_the_index_would_take_both(unpacked, wheel):
    pytest.importorskip('twine', reason='no twine: pip install the test extra')
    archive, = (unpacked.parent / 'sdist').iterdir()
    done = subprocess.run([sys.executable, '-m', 'twine', 'check', '--strict', str(archive),
                           str(wheel)], capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count('PASSED') == 2


@pytest.mark.thorough
def test_the_wheel_works_in_an_empty_environment(wheel, tmp_path):
    """Installed with nothing but its dependencies it reads pictures and writes its results."""
    bin_folder = tmp_path / 'venv' / 'bin'
    # neither this checkout nor the ROS of this process; what is compiled goes with the folder
    environment = {name: value for name, value in os.environ.items()
                   if name not in ('PYTHONPATH', 'LD_LIBRARY_PATH', 'PYTHONPYCACHEPREFIX')
                   and not name.startswith(('ROS_', '_ROS_', 'AMENT_'))}
    subprocess.run([sys.executable, '-m', 'venv', str(tmp_path / 'venv')], check=True, timeout=100,
                   env=environment)

    def run(*command, timeout=100):
        return subprocess.run([str(bin_folder / command[0]), *map(str, command[1:])],
                              cwd=tmp_path, env=environment, capture_output=True, text=True,
                              timeout=timeout)

    try:
        reached = run('pip', 'download', '--no-deps', '--no-cache-dir', '--retries', '0', '-d',
                      'probe', 'mdurl', timeout=30).returncode == 0
        installed = run('pip', 'install', '--no-compile', wheel, timeout=300) if reached else None
    except subprocess.TimeoutExpired:
        installed = None
    if installed is None:
        pytest.skip('no package index, or too slow a one')
    assert installed.returncode == 0, installed.stderr
    version = run('dashcalib', '--version').stdout
    assert version.startswith(f'dashcalib {version_of_package()} (poses: ')
    write_folder(tmp_path / 'images', drive(6, 320, 180))
    done = run('dashcalib', 'run', 'images', '--fps', '10')
    assert done.returncode == 3, done.stdout + done.stderr
    result = json.loads((tmp_path / 'calibration' / 'result.json').read_text())
    assert (result['verdict'], result['frames']) == ('refused', 6)
    assert (tmp_path / 'calibration' / 'report.html').stat().st_size > 10_000


def version_of_package():
    """Return the version in package.xml, the one place that it stands in."""
    return ElementTree.parse(ROOT / 'package.xml').findtext('version')


def test_the_version_stands_in_one_place(wheel):
    version = version_of_package()
    assert f'-{version}-' in wheel.name
    assert f'## [{version}]' in (ROOT / 'CHANGELOG.md').read_text()
    for name in ('setup.py', 'CITATION.cff', 'pyproject.toml', 'dashcalib_ros/__init__.py'):
        assert version not in (ROOT / name).read_text(), name


def test_each_python_that_ci_tries_is_named(wheel):
    name, = (each for each in zipfile.ZipFile(wheel).namelist() if each.endswith('/METADATA'))
    metadata = zipfile.ZipFile(wheel).read(name).decode()
    named = re.findall(r'^Classifier: Programming Language :: Python :: (3\.\d+)$', metadata,
                       re.MULTILINE)
    matrix = workflow('ci')['jobs']['tests']['strategy']['matrix']
    assert named == matrix['python']
    assert f'Requires-Python: >={named[0]}' in metadata


def workflow(name):
    """Return a workflow; without a clone's hidden folders there is none."""
    path = ROOT / '.github' / 'workflows' / f'{name}.yml'
    if not path.exists():
        pytest.skip('the source distribution has no workflows')
    return yaml.safe_load(path.read_text())


def test_ci_runs_what_the_readme_says():
    """Each `.ci/run TEXT` of a workflow finds one block of the README."""
    steps = [step for job in workflow('ci')['jobs'].values() for step in job['steps']]
    texts = [match[2] for step in steps if (match := re.fullmatch(
        r""".ci/run(?: (['"])(.*)\1)?""", step.get('run', '')))]
    blocks = re.findall(r'^```bash\n(.*?)^```$', (ROOT / 'README.md').read_text(),
                        re.MULTILINE | re.DOTALL)
    assert len(texts) >= 4
    for text in texts:
        assert sum((text or 'python -m pytest') in block for block in blocks) == 1, text


def test_the_docker_image_gets_all_that_the_wheel_is_made_of():
    ignored = [line.strip() for line in (ROOT / '.dockerignore').read_text().splitlines()
               if line.strip() and not line.startswith('#')]
    needed = [name for name in tracked_files()
              if name.startswith(('dashcalib_ros/', 'config/', 'launch/', 'resource/',
                                  'scripts/'))]
    needed += ['setup.py', 'setup.cfg', 'pyproject.toml', 'package.xml', 'README.md', 'LICENSE']
    for name in needed:
        parts = [name, *map(str, Path(name).parents)]
        assert not [pattern for pattern in ignored for part in parts
                    if fnmatch.fnmatch(part, pattern.removeprefix('**/'))], name


def test_the_dockerfile_s_lines_are_instructions():
    """No engine runs here: at least each line is one, and what it copies and starts is there."""
    text = (ROOT / 'Dockerfile').read_text().replace('\\\n', ' ')
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith('#')]
    assert lines[0].startswith('FROM ros:jazzy')
    assert {line.split()[0] for line in lines} <= {
        'FROM', 'RUN', 'ENV', 'COPY', 'WORKDIR', 'CMD', 'ARG', 'ENTRYPOINT', 'LABEL',
        'USER'}
    # the last words are a user's, not root's
    assert re.findall(r'^USER (\w+)$', text, re.MULTILINE)[-1] != 'root'
    command, = re.findall(r'^CMD \["([\w-]+)"', text, re.MULTILINE)
    scripts = setup_keyword('entry_points')['console_scripts']
    assert command in {script.split(' = ')[0] for script in scripts}
