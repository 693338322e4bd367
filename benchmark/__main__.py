# SPDX-License-Identifier: Apache-2.0
"""Everything that is measured: some parts or all; what is measured at this commit is not again.

    python -m benchmark all --results [--data DIR] [--again]
    python -m benchmark NAME ... [--results] [--seeds 0 1 2] [--drives NAME ...]
    python -m benchmark --list
    python -m benchmark figures

Parts run one after the other, in the order of the list. Rows and what is done go to
measured/COMMIT/, rendered pictures (20 GB for all) to measured/pictures/. --results also writes
the tables into benchmark/results/. figures: README.md and docs/ take their figures from those.
"""
from __future__ import annotations

import argparse
import re
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
ROOT = FOLDER.parent
sys.path.append(str(FOLDER))
from figures import rewrite  # noqa: E402 (benchmarks are no package)
from measure import OPTIONS, complain, load, parser_with, save  # noqa: E402
from result_tables import commit, table  # noqa: E402


@dataclass(frozen=True)
class Part:
    """A script NAME.py that writes results/NAME.md. minutes: about, on two cores."""

    name: str
    minutes: int
    what: str
    options: tuple[str, ...] = ()

    @property
    def takes(self) -> list[str]:
        """Return which of the shared options the script has."""
        text = (FOLDER / f'{self.name}.py').read_text()
        call = re.search(r'parser_with\((.*?)\)\n', text, re.DOTALL)
        return [name for name in OPTIONS if call and f"'{name}'" in call[1]]


# check solves the drives that lines, held_out and monitor read
PARTS = (
    Part('size', 5, 'what takes the room of an environment'),
    Part('check', 240, '`dashcalib check` on calibrations that are right and wrong'),
    Part('held_out', 2, 'each turn against the others; after `check`'),
    Part('monitor', 20, 'a camera that changes; after `check`'),
    Part('lines', 60, 'straight lines as a check of the distortion; after `check`'),
    Part('accuracy', 240, 'errors, sigmas, false accepts, refusals: rendered and recorded drives'),
    Part('population', 75, 'random dashcams: accepted, rays off, error over sigma, readouts'),
    Part('thorough', 70, 'all stretches of longer drives, behind a windscreen'),
    Part('spoilt_tracks', 30, 'two turns whose pictures wander or are stretched: accepted and '
         'wrong; after `population`'),
    Part('real', 60, 'recorded drives: all combinations of turns, against poses, boards and gyro'),
    Part('without_turns', 20, 'pieces of real drives without a sharp turn, with and without '
         'knowing that there is no stabiliser'),
    Part('glass', 60, 'windscreens, poor rectifications, decentred lenses'),
    Part('attacks', 150, 'videos that no fixed camera takes, and other bad ones'),
    Part('hostile', 40, 'power cuts, damaged files and messages, service calls; needs ROS'),
    Part('joined', 30, 'a drive in several files'),
    Part('variable_rate', 25, 'videos of a variable rate, and stamps of arrival'),
    Part('curves', 45, 'error over the number of turns and over the frame rate'),
    Part('ego_mask', 30, 'what the mask of the ego vehicle is worth'),
    Part('motion', 40, 'a gyro and GPS'),
    Part('clocks', 10, 'clocks of sensors and of poses, shifted'),
    Part('drift', 20, 'a focal length that grows, steps or zooms'),
    Part('rig', 60, 'several cameras of one car: rendered, halves of real pictures, a real pair'),
    Part('dark', 15, 'turns in dark and wet pictures'),
    Part('mount', 60, 'how the camera sits on the car'),
    Part('moved', 5, 'a camera that is moved within a drive'),
    Part('poses', 20, 'true poses of KITTI 03'),
    Part('fleet', 60, '`dashcalib batch`: nothing lost, short clips, the prior, effort'),
    Part('public_rows', 200, 'dashcalib and COLMAP on the drives of benchmark/public'),
    Part('rivals', 30, 'COLMAP and GLOMAP on the same images'),
    Part('engines', 15, 'the engines that estimate poses, COLMAP and OpenCV, on the same drives'),
    Part('speed', 20, 'time and memory of the command'),
    Part('node_latency', 12, 'the node at 30 Hz: latency, losses, memory; needs ROS'),
    Part('node_drive', 10, 'from the last turn to camera_info; needs ROS'),
    Part('node_soak', 62, 'the node for an hour: restarts of the driver, lost images, a camera '
         'that is mounted anew; needs ROS'),
)
BY_NAME = {part.name: part for part in PARTS}


def parts_table() -> str:
    """Return the list of parts, for benchmark/README.md."""
    total = sum(part.minutes for part in PARTS) / 60
    return table(['part', 'what it measures', 'about, min', 'options', 'writes'], [
        [f'`{part.name}`', part.what, str(part.minutes), ' '.join(part.takes),
         f'[{part.name}](results/{part.name}.md)'] for part in PARTS
    ]) + f'\n\nAll of it: about {total:.0f} hours on two cores, as estimated.'


def words_of(part: Part, given: argparse.Namespace, folder: Path) -> list[str]:
    """Return the command of a part."""
    words = [str(FOLDER / f'{part.name}.py'), *part.options, '--out', str(folder)]
    for option in part.takes:
        value = getattr(given, option)
        if value is True:
            words.append(f'--{option}')
        elif value:
            values = value if isinstance(value, list) else [value]
            words += [f'--{option}', *map(str, values)]
    return words + ['--results'] * given.results


def main() -> None:
    """Run the parts that are asked for."""
    parser = parser_with(__doc__, *OPTIONS)
    parser.add_argument('names', nargs='*', metavar='NAME', help='parts, `all` or `figures`')
    parser.add_argument('--list', action='store_true', help='name the parts, and end')
    parser.set_defaults(seeds=[], data=Path('data') if Path('data').is_dir() else None,
                        cache=ROOT / 'measured' / 'pictures', out=ROOT / 'measured')
    given = parser.parse_args()
    if given.list or not given.names:
        print(parts_table())
        return
    if given.names == ['figures']:
        sys.exit('\n'.join(rewrite(parts_table())) or None)
    if unknown := {*given.names} - {*BY_NAME, 'all'}:
        parser.error(f'there is no part {", ".join(sorted(unknown))}: --list names all')
    at = commit()
    if at.endswith('+'):
        sys.exit('commit your changes first: what is measured is of a commit. The scripts run '
                 'uncommitted: python benchmark/NAME.py')
    folder = given.out / at
    finished, failed = load(folder / 'done.json'), []
    for part in PARTS if 'all' in given.names else [BY_NAME[name] for name in given.names]:
        words = words_of(part, given, folder)
        key = ' '.join([part.name, *words[1:]])
        if key in finished and not given.again:
            continue
        complain(f'{part.name}: about {part.minutes} min')
        started = time.monotonic()
        code = subprocess.run([sys.executable, *words], cwd=Path.cwd(), check=False).returncode
        if code:
            failed.append(f'{part.name}: exit code {code}')
            complain(failed[-1])
        else:
            finished[key] = f'{(time.monotonic() - started) / 60:.1f} min'
            save(folder / 'done.json', finished)
    sys.exit('\n'.join(failed) or None)


if __name__ == '__main__':
    main()
