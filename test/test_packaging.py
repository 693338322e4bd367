"""What the source distribution and the wheel hold, and the Dockerfile takes."""
from __future__ import annotations

import ast
import fnmatch
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import pytest

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


def test_the_wheel_of_the_source_distribution_is_complete(unpacked, tmp_path):
    wheel = build(unpacked, 'wheel', tmp_path / 'wheel')
    names = zipfile.ZipFile(wheel).namelist()
    share = f'{wheel.name.split("-py3")[0]}.data/data/share'
    expected = {name for name in tracked_files() if name.startswith('dashcalib_ros/')}
    expected |= {f'{share}/dashcalib_ros/{name}' for name in tracked_files()
                 if name.startswith(('config/', 'launch/')) or name == 'package.xml'}
    expected |= {f'{share.removesuffix("share")}lib/dashcalib_ros/{name}'
                 for name in ('calibrator', 'checker')}
    expected.add(f'{share}/ament_index/resource_index/packages/dashcalib_ros')
    assert expected - set(names) == set()
    # neither tests nor documents become somebody's top-level package
    assert {name.split('/')[0].split('-')[0] for name in names} == {'dashcalib_ros'}


def test_one_version_everywhere():
    version = setup_keyword('version')
    package = ElementTree.parse(ROOT / 'package.xml')
    assert package.findtext('version') == version
    assert f'## [{version}]' in (ROOT / 'CHANGELOG.md').read_text()


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
        'FROM', 'RUN', 'ENV', 'COPY', 'WORKDIR', 'CMD', 'ARG', 'ENTRYPOINT', 'LABEL'}
    command, = re.findall(r'^CMD \["([\w-]+)"', text, re.MULTILINE)
    scripts = setup_keyword('entry_points')['console_scripts']
    assert command in {script.split(' = ')[0] for script in scripts}
