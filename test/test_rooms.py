# SPDX-License-Identifier: Apache-2.0
"""The rooms: who may import whom, and what must not be loaded before it is needed."""
from __future__ import annotations

import ast
import functools
import graphlib
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / 'dashcalib_ros'
# in the order in which data flows: a room imports from those above it
ROOMS = ('arrays', 'camera', 'input', 'detect', 'problem', 'reconstruct', 'solve', 'store',
         'judge', 'rig', 'formats', 'report', 'workers', 'selection', 'pipeline', 'session',
         'rig_session', 'standard_streams',
         'fleet', 'ros', 'demo', 'cli')
EVERYWHERE = {'config', 'errors', 'arrays', 'limits', 'robust', 'whole_files'}
# what is not simply "all rooms above"
ALLOWED: dict[str, set[str]] = {
    'config': {'errors'},
    'errors': set(),
    'limits': {'errors'},
    'arrays': {'errors'},
    'robust': {'arrays'},
    'whole_files': set(),
    '__init__': {'pipeline', 'camera', 'input', 'judge', 'formats', 'report', 'selection',
                 'session', 'rig', 'rig_session'},
    '__main__': {'cli'},
    'demo': {'camera', 'input', 'judge'},
}
# rooms that nobody but these may import
BORDERS = {'ros': set(), 'cli': {'__main__'}, 'demo': {'cli'}, 'fleet': {'cli'}}
HOMES = {'pycolmap': {'reconstruct'}, 'rclpy': {'ros'}, 'onnxruntime': {'detect'},
         'pyarrow': {'fleet', 'formats'}}
# what geometry has no use for
MACHINERY = ('threading', 'multiprocessing', 'subprocess', 'concurrent', 'queue', 'signal', 'os',
             'pathlib', 'shutil', 'tempfile', 'io')
GEOMETRY = ('camera', 'problem', 'reconstruct', 'solve', 'rig')
MODULES = sorted(PACKAGE.rglob('*.py'))


def room_of(path: Path) -> str:
    parts = path.relative_to(PACKAGE).parts
    return parts[0] if len(parts) > 1 else path.stem


@functools.cache
def imports(path: Path) -> list[tuple[str, int]]:
    """Return every module that a file imports, anywhere in it, with its line.

    In a file that imports by a text (importlib), each text that begins like a module of the
    package counts as one.
    """
    found = []
    nodes = list(ast.walk(ast.parse(path.read_text('utf-8'))))
    by_text = any(getattr(node, key, '') in ('import_module', '__import__')
                  for node in nodes for key in ('id', 'attr'))
    for node in nodes:
        if isinstance(node, ast.Import):
            found += [(alias.name, node.lineno) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path}:{node.lineno}: a relative import'
            names = [f'{node.module}.{alias.name}' for alias in node.names]
            found += [(name, node.lineno) for name in names]
        elif (by_text and isinstance(node, ast.Constant) and isinstance(node.value, str)
              and node.value.startswith(f'{PACKAGE.name}.')):
            found.append((node.value, node.lineno))
    return found


def module_graph(package: Path) -> dict[str, set[str]]:
    """Return the modules that each module of a package imports, also for type checking only.

    The package's own __init__ is left out: it loads what it re-exports at the first use.
    """
    names = {path: '.'.join([package.name, *path.relative_to(package).with_suffix('').parts]
                            ).removesuffix('.__init__') for path in package.rglob('*.py')}
    modules = set(names.values()) - {package.name}
    graph: dict[str, set[str]] = {}
    for path, module in names.items():
        found = set()
        for name, _ in imports(path):
            # the name of a module, or of something in it
            owner = next((each for each in (name, name.rpartition('.')[0]) if each in modules), '')
            # mypy says nothing of a module that is not there
            assert owner or name.count('.') < 2 or not name.startswith(f'{package.name}.'), name
            found |= {owner} - {'', module}
        if module in modules:
            graph[module] = found
    return graph


def may_import(room: str) -> set[str]:
    above = set(ROOMS[:ROOMS.index(room)]) if room in ROOMS else set()
    above -= {border for border, users in BORDERS.items() if room not in users}
    shared = EVERYWHERE if room not in EVERYWHERE else set()
    shared = shared | ({'__init__'} if room == 'cli' else set())  # __version__
    return ALLOWED.get(room, above) | shared | {room}


def test_every_folder_is_a_known_room():
    folders = {path.name for path in PACKAGE.iterdir() if (path / '__init__.py').exists()}
    files = {path.stem for path in PACKAGE.glob('*.py')}
    files -= {'__init__', '__main__', *(EVERYWHERE - {'arrays'})}
    assert folders | files == set(ROOMS)


@pytest.mark.parametrize('path', MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_only_from_rooms_above(path):
    room = room_of(path)
    for name, line in imports(path):
        package, _, rest = name.partition('.')
        if package != 'dashcalib_ros':
            continue
        other = rest.split('.')[0]
        if other not in (*ROOMS, *EVERYWHERE):
            other = '__init__'  # a name that the package itself offers
        assert other in may_import(room), f'{path}:{line}: {room} imports {name}'


def test_no_module_imports_itself_through_others():
    graph = module_graph(PACKAGE)
    assert len(graph) == len(MODULES) - 1 and 'dashcalib_ros.pipeline' in graph
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError with the modules in it


def test_a_circle_for_type_checking_would_be_noticed(tmp_path):
    package = tmp_path / 'example'
    package.mkdir()
    for name, text in {
            '__init__': 'from example.one import f', 'one': 'import example.two',
            'two': 'from typing import TYPE_CHECKING\n'
                   'if TYPE_CHECKING:\n    from example.one import f'}.items():
        (package / f'{name}.py').write_text(text)
    graph = module_graph(package)
    assert graph == {'example.one': {'example.two'}, 'example.two': {'example.one'}}
    with pytest.raises(graphlib.CycleError):
        graphlib.TopologicalSorter(graph).prepare()


@pytest.mark.parametrize('line', [
    "import_module('dashcalib_ros.report').write_results",
    "__import__('dashcalib_ros.report.files')",
    "import importlib; importlib.import_module(f'dashcalib_ros.report.{name}')"])
def test_an_import_by_a_text_would_be_noticed(tmp_path, line):
    (tmp_path / 'hidden.py').write_text(line)
    assert any(name.startswith('dashcalib_ros.report')
               for name, _ in imports(tmp_path / 'hidden.py'))


def test_the_rules_would_notice():
    assert 'ros' not in may_import('cli') and 'cli' not in may_import('ros')
    assert 'demo' in may_import('cli') and 'demo' not in may_import('ros')
    assert 'solve' not in may_import('reconstruct')
    assert may_import('input') == {'input', 'camera'} | EVERYWHERE
    assert 'calibrator' not in may_import('report')


@pytest.mark.parametrize('room', GEOMETRY)
def test_geometry_knows_no_threads_processes_or_files(room):
    for path in (PACKAGE / room).glob('*.py'):
        for name, line in imports(path):
            assert name.split('.')[0] not in MACHINERY, f'{path}:{line} imports {name}'


@pytest.mark.parametrize('library', HOMES)
def test_libraries_stay_in_their_rooms(library):
    users = {room_of(path) for path in MODULES
             if any(name.split('.')[0] == library for name, _ in imports(path))}
    assert users and users <= HOMES[library]


def test_zlib_comes_before_pycolmap_in_the_one_module_that_imports_it():
    users = [path for path in MODULES
             if any(name.split('.')[0] == 'pycolmap' for name, _ in imports(path))]
    assert len(users) == 1
    lines = {}
    for name, line in imports(users[0]):
        lines.setdefault(name, line)
    assert lines['zlib'] < lines['pycolmap']


def loaded_by(code: str, *modules: str) -> set[str]:
    """Return which of the modules a fresh interpreter has loaded after some code."""
    check = f'\nimport sys\nprint("loaded:", *({set(modules)!r} & set(sys.modules)))'
    result = subprocess.run(
        [sys.executable, '-c', code + check], cwd=PACKAGE.parent, text=True, timeout=60,
        capture_output=True, check=True)
    last = result.stdout.splitlines()[-1]
    assert last.startswith('loaded:')
    return set(last.split()[1:])


@pytest.mark.parametrize('module', [
    'dashcalib_ros', 'dashcalib_ros.judge', 'dashcalib_ros.pipeline',
    'dashcalib_ros.workers.pool'])
def test_colmap_is_loaded_by_the_child_only(module):
    assert loaded_by(f'import {module}', 'pycolmap', 'rclpy') == set()


def test_the_processes_that_reconstruct_turns_load_no_more_than_they_need():
    assert loaded_by('import dashcalib_ros.reconstruct.build', 'scipy', 'rosbags', 'rich') == set()


def test_a_result_and_its_report_need_no_scipy():
    # it takes half a second to load, and 27 MB and more, in each process
    code = """
import sys, zlib
sys.path[:0] = ['test', 'testing']
import numpy as np
from made_calibration import MOUNT, make_calibration
from solving import CONFIG, scenes_of
from synthetic import LENS, SIZE
from dashcalib_ros.detect.straights import Straights
from dashcalib_ros.input.scale import FULL_SIZE
from dashcalib_ros.judge.conclude import Evidence, conclude
from dashcalib_ros.reconstruct.repeated import without_repeated
from dashcalib_ros.formats import result_json
from dashcalib_ros.report.page import report_html
from dashcalib_ros.solve import solve
scenes, repeated = without_repeated(scenes_of(3))
points = np.random.default_rng(0).uniform(50, 250, (12, 60, 2)).astype(np.float32)
found = conclude(solve(scenes, CONFIG), Evidence(
    SIZE, 300, (), {}, np.zeros((0, 2)), None, FULL_SIZE, {},
    straights=Straights(points, points + 1, np.arange(12.0), np.full(12, 0.6))), CONFIG)
assert found.camera is not None and not repeated
result_json(found), report_html(found), report_html(make_calibration(mount=MOUNT))
"""
    assert loaded_by(code, 'scipy', 'jinja2') == {'jinja2'}


@pytest.mark.parametrize(('engine', 'loaded'), [('pycolmap', {'pycolmap'}), ('opencv', set())])
def test_colmap_is_loaded_where_it_is_used(engine, loaded):
    code = f'from dashcalib_ros.reconstruct import load\nload({engine!r})'
    assert loaded_by(code, 'pycolmap') == loaded


def test_a_live_calibrator_loads_nothing_large_while_images_come():
    # an import in the node's process keeps it from receiving: images were lost that way
    code = 'from dashcalib_ros.pipeline import Calibrator\nCalibrator(live=True).close()'
    wanted = {'scipy.special', 'scipy.spatial.transform', 'scipy.optimize',
              'dashcalib_ros.judge.conclude'}
    assert loaded_by(code, *wanted, 'pycolmap') == wanted


def test_the_package_alone_loads_no_opencv():
    assert loaded_by('import dashcalib_ros', 'cv2', 'scipy', 'numpy') == set()


@pytest.mark.parametrize('arguments', [['--help'], ['run', '--help'], ['--version']])
def test_help_loads_neither_opencv_nor_scipy(arguments):
    code = (f'import sys\nsys.argv = ["dashcalib", *{arguments!r}]\n'
            f'from dashcalib_ros.cli.program import main\n'
            f'try:\n    main()\nexcept SystemExit as end:\n    assert not end.code, end.code')
    assert loaded_by(code, 'cv2', 'scipy', 'pycolmap', 'rclpy') == set()
