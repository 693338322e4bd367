"""The rooms: who may import whom, and what must not be loaded before it is needed."""
from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / 'dashcalib_ros'
ROOMS = ('frames', 'motion', 'turns', 'reconstruction', 'intrinsics', 'report', 'ros', 'demo',
         'cli')
CORE = {'frames', 'motion', 'turns', 'reconstruction', 'intrinsics'}
EVERYWHERE = {'config', 'errors'}
# what is not simply "all rooms above"
ALLOWED = {
    'config': {'errors'},
    'errors': set(),
    'calibrator': CORE,
    '__init__': {'calibrator', 'frames'},
    'report': CORE,
    'ros': CORE | {'report', 'calibrator'},
    'demo': {'frames', 'intrinsics'},
    'cli': CORE | {'report', 'demo', 'calibrator'},
}
HOMES = {'pycolmap': {'reconstruction', 'intrinsics'}, 'pyceres': {'reconstruction', 'intrinsics'},
         'rclpy': {'ros'}, 'onnxruntime': {'motion'}}
MODULES = sorted(PACKAGE.rglob('*.py'))


def room_of(path: Path) -> str:
    parts = path.relative_to(PACKAGE).parts
    return parts[0] if len(parts) > 1 else path.stem


def imports(path: Path) -> list[tuple[str, int]]:
    """Return every module that a file imports, anywhere in it, with its line."""
    found = []
    for node in ast.walk(ast.parse(path.read_text('utf-8'))):
        if isinstance(node, ast.Import):
            found += [(alias.name, node.lineno) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path}:{node.lineno}: a relative import'
            names = [f'{node.module}.{alias.name}' for alias in node.names]
            found += [(name, node.lineno) for name in names]
    return found


def may_import(room: str) -> set[str]:
    above = set(ROOMS[:ROOMS.index(room)]) if room in ROOMS else set()
    return ALLOWED.get(room, above) | (EVERYWHERE if room != 'errors' else set()) | {room}


def test_every_folder_is_a_known_room():
    folders = {path.name for path in PACKAGE.iterdir() if (path / '__init__.py').exists()}
    assert folders == set(ROOMS)


@pytest.mark.parametrize('path', MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_only_from_rooms_above(path):
    room = room_of(path)
    for name, line in imports(path):
        package, _, rest = name.partition('.')
        if package != 'dashcalib_ros':
            continue
        other = rest.split('.')[0]
        if other not in (*ROOMS, *EVERYWHERE, 'calibrator'):
            other = '__init__'  # a name that the package itself offers
        assert other in may_import(room), f'{path}:{line}: {room} imports {name}'


def test_the_rules_would_notice():
    assert 'ros' not in may_import('cli') and 'cli' not in may_import('ros')
    assert 'intrinsics' not in may_import('reconstruction')
    assert may_import('frames') == {'frames', 'config', 'errors'}
    assert 'calibrator' not in may_import('report')


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
    assert lines['zlib'] < lines['pycolmap'] and lines['zlib'] < lines['pyceres']


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
    'dashcalib_ros', 'dashcalib_ros.intrinsics', 'dashcalib_ros.calibrator',
    'dashcalib_ros.reconstruction.workshop'])
def test_colmap_is_loaded_by_the_child_only(module):
    assert loaded_by(f'import {module}', 'pycolmap', 'pyceres', 'rclpy') == set()


def test_colmap_is_loaded_where_it_is_used():
    code = 'import dashcalib_ros.reconstruction.adjust'
    assert loaded_by(code, 'pycolmap', 'pyceres') == {'pycolmap', 'pyceres'}


def test_the_package_alone_loads_no_opencv():
    assert loaded_by('import dashcalib_ros', 'cv2', 'scipy', 'numpy') == set()


@pytest.mark.parametrize('arguments', [['--help'], ['run', '--help'], ['--version']])
def test_help_loads_neither_opencv_nor_scipy(arguments):
    code = (f'import sys\nsys.argv = ["dashcalib", *{arguments!r}]\n'
            f'from dashcalib_ros.cli.program import main\n'
            f'try:\n    main()\nexcept SystemExit as end:\n    assert not end.code, end.code')
    assert loaded_by(code, 'cv2', 'scipy', 'pycolmap', 'rclpy') == set()
