# SPDX-License-Identifier: Apache-2.0
"""What takes the room of an environment: each installed package, and what needs it.

    python benchmark/size.py [--out DIR] [--results]

Makes an environment with only this package in DIR/light, by pip; one that is there is kept.
"""
from __future__ import annotations

import re
import subprocess
import sys
from collections import defaultdict
from importlib.metadata import Distribution, distributions
from pathlib import Path

from measure import keep_table, parser_with, table

PACKAGE = 'dashcalib_ros'
ROOT = Path(__file__).parents[1]
# why a light use needs it, or what is lost without it
REASONS = {
    'scipy': 'rotations, splines, sparse solvers: everywhere in the solution',
    'opencv-python-headless': 'tracks, pictures, poses without pycolmap',
    'pycolmap': 'poses; without it (`pip uninstall pycolmap`) OpenCV estimates them, as on arm64',
    'av': "videos, also in bags, with each picture's own time",
    'numpy': 'everything',
    'zstandard': 'mcap requires it',
    'apsw': 'bags in SQLite; rosbags requires it, too',
    'pip': 'made with the environment',
    'setuptools': "made with the environment up to Python 3.11; ROS's tools want it",
    'pygments': 'rich requires it',
    PACKAGE: 'this package',
}


def normal(name: str) -> str:
    """Return a package's name as package indexes compare it."""
    return re.sub(r'[-_.]+', '-', name).lower()


def sizes(package: Distribution) -> tuple[int, int]:
    """Return the bytes of a package's files, and how many of them are compiled Python."""
    files = [(name, Path(str(package.locate_file(name)))) for name in package.files or []]
    found = [(name.suffix == '.pyc', path.stat().st_size) for name, path in files
             if path.is_file()]
    return sum(size for _, size in found), sum(size for compiled, size in found if compiled)


def environment(folder: Path) -> Path:
    """Make an environment with this package alone; return where its packages are."""
    if not folder.exists():
        making = folder.with_name(f'{folder.name}.new')
        subprocess.run([sys.executable, '-m', 'venv', '--clear', making], check=True)
        subprocess.run([making / 'bin' / 'python', '-m', 'pip', 'install', '--quiet', ROOT],
                       check=True)
        making.rename(folder)
    return next((folder / 'lib').glob('python3*/site-packages'))


def packages_table(path: Path) -> str:
    """Return the table of an environment: what is 2 MB or more, and the rest as one row."""
    packages = {normal(each.name): each for each in distributions(path=[str(path)])}
    reasons = {normal(name): reason for name, reason in REASONS.items()}
    needed_by = defaultdict(set)
    for name, package in packages.items():
        for line in package.requires or []:
            if 'extra ==' not in line:
                needed_by[normal(re.split(r'[^\w.-]', line)[0])].add(name)
    found = {name: sizes(package) for name, package in packages.items()}
    whole, compiled = (sum(column) for column in zip(*found.values(), strict=True))
    rows = [['all', f'{whole / 1e6:.0f}', '', f'{compiled / 1e6:.0f} MB of it is compiled Python, '
             'of which `pip install --no-compile` makes only what is used']]
    large = sorted((name for name in found if found[name][0] >= 2e6),
                   key=lambda name: found[name], reverse=True)
    for name in large:
        rows.append([name, f'{found[name][0] / 1e6:.0f}', ', '.join(sorted(needed_by[name])),
                     reasons.get(name, '')])
    rest = sum(size for name, (size, _) in found.items() if name not in large)
    rows.append([f'{len(found) - len(large)} others', f'{rest / 1e6:.0f}', '', ''])
    return table(['package', 'MB', 'required by', 'why'], rows)


def main() -> None:
    """Print the table, or write it."""
    given = parser_with(__doc__).parse_args()
    keep_table('size', packages_table(environment(given.out / 'light')), given)


if __name__ == '__main__':
    main()
