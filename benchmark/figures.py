# SPDX-License-Identifier: Apache-2.0
"""README.md and docs/ take their figures from the tables of results/; this has the list of them.

A new figure is a row of FIGURES: a place on a page, the table, and what is read from the table.
`python -m benchmark figures` puts the figures there, and test/test_figures.py compares.
"""
from __future__ import annotations

import re
import statistics
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from result_tables import BEGIN, END, RESULTS

ROOT = Path(__file__).resolve().parents[1]
NUMBER = r'[-+−]?\d+(?:[.,]\d+)*(?: ± \d+(?:\.\d+)?)?'
COMMITS = r'[0-9a-f]{7}(?:, [0-9a-f]{7})*'
# of a table on a page; what it says instead of more commits than a reader looks up
CITED, LISTED = rf'\[(?:{COMMITS}|\d+ commits)\]', 3
PARTS = '<!-- parts -->', '<!-- end of parts -->'
# nothing older belongs on the front page
MOST_COMMITS = 200
HOPELESS = ('straight on', 'parked', 'at a light, others moving', 'parked at night',
            'turning on the spot')
Source = Callable[[str], list[str]]


@dataclass(frozen=True)
class Figure:
    """A place on a page that says what a table says.

    place: text of the page, once in it, however wrapped; each # is a number, @ the link to the
    table, whose text is cited(). sources: what returns the numbers, in their order,
    from the table's text; [] where it does not.
    """

    page: str
    place: str
    table: str
    sources: tuple[Source, ...]

    @property
    def pattern(self) -> re.Pattern[str]:
        """Return what the place looks like with any figures."""
        spaced = re.escape(self.place).replace('\\ ', r'\s+').replace('\\#', f'({NUMBER})')
        link = f'{"../" * self.page.count("/")}benchmark/results/{self.table}.md'
        return re.compile(spaced.replace('@', rf'{CITED}\({re.escape(link)}\)'))

    def with_figures(self, text: str) -> str:
        """Return the page's text with the table's figures in the place. Raises ValueError."""
        table = table_of(self.table)
        numbers = [number for source in self.sources for number in source(table)]
        if len(numbers) != self.place.count('#'):
            raise ValueError(f'{self.table}.md has {numbers} for "{self.place}" of {self.page}')
        places = [*self.pattern.finditer(text)]
        if len(places) != 1:
            raise ValueError(f'{self.page} has {len(places)} places "{self.place}", not one')
        # lines end where they did
        for group in reversed(range(len(numbers))):
            begin, end = places[0].span(group + 1)
            text = text[:begin] + numbers[group] + text[end:]
        return text


def with_commits(text: str) -> str:
    """Return a page's text with the commits of each table that it links to by its commits."""
    return re.sub(rf'{CITED}(?=\([./]*benchmark/results/(\w+)\.md\))',
                  lambda link: f'[{cited(table_of(link[1]))}]', text)


def cited(table: str) -> str:
    """Return what pages say about the commits of a table: which they are, or how many."""
    count = len(commits_of(table).split(', '))
    return commits_of(table) if count <= LISTED else f'{count} commits'


def table_of(name: str) -> str:
    """Return what stands between the markers of a table."""
    return (RESULTS / f'{name}.md').read_text('utf-8').partition(BEGIN)[2].partition(END)[0]


def commits_of(table: str) -> str:
    """Return the commits that a table was measured at; '' where they were not kept."""
    found = re.match(rf'\s*Measured at ({COMMITS})', table)
    return found[1] if found else ''


def rows_of(table: str) -> Iterator[list[str]]:
    """Yield the cells of each row of a table, bold and code marks removed."""
    for line in table.splitlines():
        if line.startswith('|'):
            yield [cell.strip(' *`') for cell in line.strip('|').split('|')]


def cell(row: str, column: str, part: str = NUMBER) -> Source:
    """Return a source: part of a cell, by the texts of its row's first cell and of its column."""
    def read(table: str) -> list[str]:
        head: list[str] = []
        for cells in rows_of(table):
            if column in cells:
                head = cells
            elif cells[0] == row and head:
                found = re.search(part, cells[head.index(column)])
                return [found[1] if found.groups() else found[0]] if found else []
        return []
    return read


def found(*patterns: str) -> Source:
    """Return a source: the groups of the first of these patterns that the table has."""
    def read(table: str) -> list[str]:
        for pattern in patterns:
            if match := re.search(pattern, table):
                named = match.groupdict()
                return [named[key] for key in sorted(named)] or [*match.groups()]
        return []
    return read


def accuracy(table: str) -> tuple[list[list[str]], list[list[str]]]:
    """Return the rows of rendered drives with turns, and of hopeless ones."""
    first = table[table.index('| drive |'):].partition('\n\n')[0]
    rows = [cells for cells in rows_of(first) if re.match(r'\d+ \w+', cells[1])]
    return ([cells for cells in rows if cells[0] not in HOPELESS],
            [cells for cells in rows if cells[0] in HOPELESS])


def settings(table: str) -> list[str]:
    """Return how many settings are all accepted, of how many; fx off: median, most; sigmas."""
    rows = accuracy(table)[0]
    good = [cells for cells in rows if re.fullmatch(r'\d+ accepted', cells[1])]
    off = [float(cells[4]) for cells in good]
    return [str(len(good)), str(len(rows)), f'{statistics.median(off):.2f}', f'{max(off):.2f}',
            f'{max(float(cells[10]) for cells in good):.1f}']


def refused(table: str) -> list[str]:
    """Return how many hopeless settings are all refused, of how many."""
    rows = accuracy(table)[1]
    return [str(sum(bool(re.fullmatch(r'\d+ refused', cells[1])) for cells in rows)),
            str(len(rows))]


def of_model(model: str) -> Source:
    """Return a source: the settings with this lens, and the most px off over the picture."""
    def read(table: str) -> list[str]:
        rows = [cells for cells in accuracy(table)[0] if cells[2] == model]
        return [str(len(rows)), max((cells[3] for cells in rows), key=float)]
    return read


def attacks(table: str) -> list[str]:
    """Return the videos, those accepted, and those accepted and wrong."""
    rows = [cells for cells in rows_of(table) if len(cells) == 11 and cells[1].isdigit()]
    return [str(sum(int(cells[n]) for cells in rows)) for n in (1, 2, 10)]


def off_by(*truths: float) -> Source:
    """Return a source: by how many % fx of KITTI 03 and 07 is off from these."""
    def read(table: str) -> list[str]:
        return [f'{100 * abs(float(cell(name, "fx, px", r"[0-9.]+")(table)[0]) / truth - 1):.1f}'
                for name, truth in zip(('kitti03', 'kitti07'), truths, strict=True)]
    return read


def glass(table: str) -> list[str]:
    """Return those accepted, of all behind glass; rays off and fx off in %, the most."""
    rows = [cells for cells in rows_of(table) if cells[0].endswith(' px')]
    accepted = [int(count) for cells in rows for count in re.findall(r'(\d+) accepted', cells[1])]
    drives = [int(count) for cells in rows for count in re.findall(r'(\d+) \w+', cells[1])]
    off = [max(abs(float(each)) for cells in rows for each in cells[n].split())
           for n in (3, 7)]
    return [str(sum(accepted)), str(sum(drives)), *(f'{each:.2f}' for each in off)]


def spoilt(table: str) -> list[str]:
    """Return the drives of two spoilt turns, those accepted, and those accepted and wrong."""
    rows = [cells for cells in rows_of(table) if len(cells) == 8 and cells[1].isdigit()]
    return [str(sum(int(cells[n]) for cells in rows)) for n in (1, 2, 5)]


def uncut(table: str) -> list[str]:
    """Return how many drives that lost nothing between files have the same result, of all."""
    rows = [cells for cells in rows_of(table) if len(cells) > 7 and cells[2] == '0']
    return [str(sum({*cells[6:]} == {'0.00'} for cells in rows)), str(len(rows))]


def hidden(table: str) -> list[str]:
    """Return the drives whose stamps hide a loss, those accepted, and the most sigmas."""
    rows = [cells for cells in rows_of(table) if len(cells) > 7 and cells[2].endswith('not told')]
    return [str(len(rows)), str(sum(cells[4] == 'accepted' for cells in rows)),
            max((each for cells in rows for each in cells[6:]), key=float)]


def arrival(table: str) -> list[str]:
    """Return how many readouts by stamps of arrival are within 2 sigma, of how many."""
    rows = [cells for cells in rows_of(table) if 'arrival' in cells[0]]
    found = [(float(cells[0].split()[0]), *map(float, cells[2].split(' ± '))) for cells in rows]
    return [str(sum(abs(value - true) <= 2 * sigma for true, value, sigma in found)),
            str(len(found))]


def hostile(table: str) -> list[str]:
    """Return how many attacks held in each try, of how many."""
    rows = [cells[1] for cells in rows_of(table) if re.match(r'\d+ of|not tried', cells[1])]
    return [str(sum(len({*each.split(' of ')}) == 1 and each != 'not tried' for each in rows)),
            str(len(rows))]


def lines(table: str) -> list[str]:
    """Return the true cameras within two sigma and the spoilt ones beyond, each of how many."""
    asked = [cells for cells in rows_of(table) if len(cells) == 7 and '±' in cells[3]]
    spoilt = [tuple(map(float, each.split(' ± ')))
              for cells in asked for each in cells[5:] if each]
    return [str(sum(float(cells[4]) <= 2 for cells in asked)), str(len(asked)),
            str(sum(abs(k1) > 2 * sigma for k1, sigma in spoilt)), str(len(spoilt))]


def stabilised(table: str) -> list[str]:
    """Return the stabilised videos that were accepted, all, and those whose trouble was named."""
    rows = [cells for cells in rows_of(table) if cells[0].startswith('stabilised')]
    return [str(sum(int(cells[n] or 0) for cells in rows)) for n in (2, 1, 6)]


def all_of(row: str) -> Source:
    """Return a source: the sum of a row of check.md's answers."""
    def read(table: str) -> list[str]:
        answers = next(cells for cells in rows_of(table) if cells[0] == row)[1:-2]
        return [str(sum(map(int, answers)))]
    return read


def roll(table: str) -> list[str]:
    """Return the largest roll off on a crowned road, and its sigma."""
    rows = [cells[5] for cells in rows_of(table) if cells[0].startswith('crown')]
    worst = max(rows, key=lambda each: abs(float(each.split()[0])))
    return re.findall(r'\d+\.\d+', worst)


def least_times(table: str) -> list[str]:
    """Return the least ratio of COLMAP's processor time to ours."""
    times = re.findall(r'COLMAP, incremental.*\*\*(\d+), (\d+), (\d+)\*\*', table)
    new = re.findall(r'COLMAP, turns \|(?:[^|]*\|){9} ([\d.]+) \|', table)
    return [str(min(map(float, [*new, *sum(times, ())])))[:4].removesuffix('.0')]


def fx_of(column: str, *drives: str) -> tuple[Source, ...]:
    """Return sources: the first focal length and sigma in a column of real.md."""
    return tuple(cell(drive, column, r'\d+\.\d ± \d+\.\d') for drive in drives)


README, PROOF, LIMITS = 'README.md', 'docs/proof.md', 'docs/limits.md'
# where two patterns are given, the first reads what was copied by hand, the other what is written
POPULATION = (
    found(r'\| sound lenses accepted \| (\d+) of (\d+)',
          r'\| no glass \| (?P<b>\d+) \| (?P<a>\d+) '),
    found(r'\| behind glass accepted; .*? \| (\d+) of (\d+)',
          r'\| behind glass \| (?P<b>\d+) \| (?P<a>\d+) '),
    found(r'\| fx more than 3 sigma, or 1 %, off \| (\d+) \|'),
    found(r'\| parameters within 1, 2, 3 sigma, % \| (\d+), (\d+)',
          r'(?s)\| parameters within 1 sigma \| ([\d.]+)%.*?within 2 sigma \| ([\d.]+)%'))
RAYS = (found(r'\| accepted, rays with the field off, px: median; 95 % \| ([\d.]+); ([\d.]+)',
              r'(?s)\| rays off, px: median \| ([\d.]+) .*?95 % \| ([\d.]+)'),)
READOUTS = (found(r'\| readouts of 5 ms.*?\| ([\d.]+) %; (\d+) of (\d+)',
                  r'(?s)Readouts of.*?\| all \|(?:[^|]*\|){2} ([\d.]+) \| (\d+) of (\d+)'),)
MOUNT = (found(r'Rendered, (\d+) angles: median ([\d.]+)°, worst ([\d.]+)°, within 2σ (\d+)%'),)
NODE = (found(r'camera_info published \| (\d+)'), found(r'received by the node \| (\d+)'),
        found(r'while it calibrates: median.*?\| ([\d.]+),'), found(r'of one core \| ([\d.]+) %'))
EXACT = (found(r'\| 0 \| global shutter \|[^|]*\| ([\d.]+); ([\d.]+)'),)
CLOCKS = (found(r'or not found: (\d+) of (\d+); from what .* without a shift: (\d+)'),)


def without_turns(known: str, drives: str = 'Real pieces') -> Source:
    """Return a source: these drives, those with a number, how far these are off."""
    return found(rf'{drives}, stabiliser {known}: (\d+) drives, (\d+) numbers, .*?; ([\d.]+) '
                 r'sigmas RMS, (\d+) beyond 2, \d+ beyond 3; sigma ([\d.]+) %')


HEIGHT = 'not known; speed and height are'


RIG = (found(r'Rendered: (\d+) cameras, (\d+) placed, (\d+) accepted; the worst ([\d.]+) sigmas '
             r'off; sigma about the worst axis ([\d.]+)°'),
       *(found(rf'halves of {name} \|(?:[^|]*\|){{6}} ([\d.]+) \|')
         for name in ('kitti07', 'kitti_raw')))


FIGURES = (
    Figure(README, '# of # sound lenses and # of # behind glass accepted, # wrong; # % of the '
           'parameters within 1 sigma, # % within 2 | @ |', 'population', POPULATION),
    Figure(README, '| # of # (KITTI 03), # of # (KITTI 07), # of # (ntu_campus). They share '
           'turns | @ |', 'real', tuple(found(rf'\| {name} \|.*?\| (\d+) of (\d+) \|')
                                        for name in ('kitti03', 'kitti07', 'ntu_campus'))),
    Figure(README, '| fx # and # px; true rotation says # and # px | @ |', 'real', (
        *fx_of('fx, px', 'kitti03', 'kitti07'), *fx_of('judged by', 'kitti03', 'kitti07'))),
    Figure(README, '| fx # px; the chessboard has # px | @ |', 'real', (
        *fx_of('fx, px', 'kitti_raw'), *fx_of('judged by', 'kitti_raw'))),
    Figure(README, '| rays # px off in the median, # px at most | @ |', 'exact', EXACT),
    Figure(README, '| # drives, # accepted, # of them with a parameter more than 3.5 sigma off '
           '| @ |', 'spoilt_tracks', (spoilt,)),
    Figure(README, '| # pieces, # with an fx; # sigmas RMS off, # beyond 2; sigma # % in the '
           'median. Its height and the speed known instead: # pieces, # with an fx; # sigmas RMS '
           'off, # beyond 2; sigma # % | @ |', 'without_turns', (
               without_turns('no'), without_turns(HEIGHT))),
    Figure(README, '| # of # offsets not within 2 sigma, one sensor of one drive; of the shifts '
           'alone # | @ |', 'clocks', CLOCKS),
    Figure(README, '| # cameras, # placed, # accepted after three turns; the worst # sigmas off; '
           'sigma #° in the median. Halves of real pictures, weak: # and # sigmas off | @ |',
           'rig', RIG),
    Figure(README, '| # of # images answered, # ms in the median, # % of a core | @ |',
           'node_latency', NODE),
    Figure(PROOF, '| # pieces, # with an fx: # sigmas RMS off, # beyond 2; sigma # % | @ |',
           'without_turns', (without_turns('no'),)),
    Figure(PROOF, '| # pieces, # with an fx, at best weak: # sigmas RMS off, # beyond 2; sigma # '
           '% | @ |', 'without_turns', (without_turns('not known'),)),
    *(Figure(PROOF, f'| # {drives}, # with an fx by their height: # sigmas RMS off, # beyond 2; '
             'sigma # % | @ |', 'without_turns', (without_turns(HEIGHT, of),))
      for drives, of in (('pieces', 'Real pieces'), ('spoilt ones', 'Spoilt'))),
    Figure(PROOF, '| # spoilt ones, # with an fx: # sigmas RMS off, # beyond 2; sigma # % | @ |',
           'without_turns', (without_turns('not known', 'Spoilt'),)),
    Figure(PROOF, '| # of # accepted: # and # px, # and # sigmas off | @ |', 'without_turns', (
        found(r'Fleets, stabiliser no: (?P<b>\d+) drives, \d+ numbers, (?P<a>\d+) accepted'),
        found(r'(?s)\| kitti03 \| fleet .*?\| (\d+\.\d ± \d+\.\d) \|.*?'
              r'\| carnd \| fleet .*?\| (\d+\.\d ± \d+\.\d) \|'),
        found(r'(?s)\| kitti03 \| fleet [^\n]*[-+]([\d.]+) \|\n.*?'
              r'\| carnd \| fleet [^\n]*[-+]([\d.]+) \|\n'))),
    Figure(PROOF, '| fx # and # px | @ |', 'node_drive', (
        found(r'fx (\d+\.\d ± \d+\.\d) px', r'(?s)KITTI 03.*?\| fx \| (\d+\.\d)'),
        found(r'with other turns: (\d+\.\d ± \d+\.\d)', r'(?s)KITTI 03.*?reference (\d+\.\d)'))),
    Figure(PROOF, '| # of #, # of #; #; # and # % | @ |', 'population', POPULATION),
    Figure(PROOF, 'with the field, off in the median and 95 % | # and # px | @ |', 'population',
           RAYS),
    Figure(PROOF, 'readouts off in the median; within 2 sigma | # %; # of # | @ |', 'population',
           READOUTS),
    Figure(PROOF, '| # of # accepted; # and # %; # sigma | @ |', 'accuracy', (settings,)),
    Figure(PROOF, '| # of # refused | @ |', 'accuracy', (refused,)),
    Figure(PROOF, '| # fisheyes, at most # px; # with p1, p2 or k3, at most # px | @ |',
           'accuracy', (of_model('fisheye'), of_model('brown'))),
    Figure(PROOF, '| fx # px, true rotation #; # px, true rotation # | @ |', 'real', tuple(
        source for name in ('kitti03', 'kitti07') for column in ('fx, px', 'judged by')
        for source in fx_of(column, name))),
    Figure(PROOF, '| fx # px, the chessboard # | @ |', 'real', (
        *fx_of('fx, px', 'kitti_raw'), *fx_of('judged by', 'kitti_raw'))),
    Figure(PROOF, '| fx # px, the closed loop # | @ |', 'real', (
        *fx_of('fx, px', 'ntu_campus'), *fx_of('judged by', 'ntu_campus'))),
    Figure(PROOF, '| # % and # % | @ |', 'real', (
        cell('kitti03', 'scale drift %: shipped K'), cell('kitti03', 'ours'))),
    Figure(PROOF, '| ours, KITTI 03; KITTI 07 | the whole drive | #; # |', 'real',
           (off_by(721.5377, 707.0912),)),
    Figure(PROOF, "| ours, against true rotation instead of KITTI's K | the same | #; # |", 'real',
           (off_by(718.2, 701.9),)),
    Figure(PROOF, '| # of # accepted; rays at most # px, fx at most # % off | @ |', 'glass',
           (glass,)),
    Figure(PROOF, '| # angles: #° in the median, #° at the worst (roll on a crowned road); # % '
           'within 2 sigma | @ |', 'mount', MOUNT),
    Figure(PROOF, '| KITTI 03 and 07: # and # m, nominal 1.65 m | @ |', 'mount', tuple(
        cell(name, 'height m (σ)', r'[\d.]+') for name in ('kitti03', 'kitti07'))),
    Figure(PROOF, '| # videos, # accepted, # of them wrong | @ |', 'attacks', (attacks,)),
    Figure(PROOF, '| # of # results are the same to the last digit | @ |', 'joined', (uncut,)),
    Figure(PROOF, '| of # drives # are accepted, a parameter at most # sigma from the whole | @ |',
           'joined', (hidden,)),
    Figure(PROOF, '| # of # readouts within 2 sigma | @ |', 'variable_rate', (arrival,)),
    Figure(PROOF, '| # of # kinds of attack held in each try | @ |', 'hostile', (hostile,)),
    Figure(PROOF, '| accepted with 1, 2 and 5 turns: #, #, # of 3 | @ |', 'curves', tuple(
        cell(f'turns: {n}', 'accepted', r'^\d+') for n in (1, 2, 5))),
    Figure(PROOF, '| of # true calibrations # are called wrong; fx 2 % off is found in # of # '
           'drives that can tell, k1 0.03 off in # of # | @ |', 'check', (
               all_of('truth'), cell('truth', 'wrong'),
               found(r'\| fx \+ \|.*?\| (\d+) of (\d+) \|'),
               found(r'\| k1 \+ \|.*?\| (\d+) of (\d+) \|'))),
    Figure(PROOF, '| # of # true cameras within 2 sigma; # of # with k1 0.03 off beyond | @ |',
           'lines', (lines,)),
    Figure(PROOF, '| # of # turns differ from the others by less than both sigmas | @ |',
           'held_out', (found(r'\| \d+ \| (?P<b>\d+) \| (?P<a>\d+) \|',
                              r'(\d+) of (\d+) turns within'),)),
    Figure(PROOF, '| # false alarms in # drives; within three turns: zoom of 2 % in # %, k1 0.02 '
           'higher in # %, 1° to a side in # % | @ |', 'monitor', (
               found(r'\| none \|.*?(\d+) of (\d+) \|'), *(
                   cell(row, '3', r'[\d.]+') for row in (
                       'zoom -2 %', 'k1 0.02 higher', 'turned 1° to a side')))),
    Figure(PROOF, '| # s, # CPU s, # MB | @ |', 'speed', (
        found(r'KITTI 03; \w+ \| ([\d.]+) \| ([\d.]+) \| [\d.]+ \| (\d+) \|'),)),
    Figure(PROOF, '| #, #, # images/s | @ |', 'speed', tuple(
        cell(size, 'frames/s') for size in ('640x480', '1280x720', '1920x1080'))),
    Figure(PROOF, '| # and # MB | @ |', 'speed', tuple(
        cell('MB', column) for column in ('first minute', 'last'))),
    Figure(PROOF, '| # of # images answered, # ms in the median, # % of a core | @ |',
           'node_latency', NODE),
    Figure(PROOF, '| at least # times ours | @ |', 'rivals', (least_times,)),
    Figure(PROOF, '| # of # units: fx # % off alone, # % with the prior, in the median | @ |',
           'fleet', (found(r'\ball(?: \||:) (\d+) of (\d+)(?: \||,) ([\d.]+)(?: \||,) '
                           r'([\d.]+)'),)),
    Figure(LIMITS, 'off by # px in the median and # px in 95 % (@)', 'population', RAYS),
    Figure(LIMITS, 'readouts are # % off in the median, and the truth within 2 sigma # of # times '
           '(@)', 'population', READOUTS),
    Figure(LIMITS, 'of those accepted it was up to # of its sigma off (@)', 'population', (
        found(r'\| accepted \| cy \|.* ([\d.]+) \|'),)),
    Figure(LIMITS, 'roll is #° off, with a sigma of #° (@)', 'mount', (roll,)),
    Figure(LIMITS, 'fx is # % and fy # % off, at 1242×375 # and # % (@', 'accuracy', tuple(
        cell(name, column) for name in ('kitti03, a third', 'kitti03')
        for column in ('fx %', 'fy %'))),
    Figure(LIMITS, 'was accepted in # of 3 drives (@)', 'curves', (
        cell('turns: 1', 'accepted', r'^\d+'),)),
    Figure(LIMITS, 'Of stabilised videos # of # were accepted, and the trouble was named in # (@)',
           'attacks', (stabilised,)),
    Figure(LIMITS, 'a sigma of fx of # px on a piece of KITTI 03 (@)', 'without_turns', (
        found(r'\| kitti03 \| 10 \| 10 s \| not known \|.*? ± ([\d.]+) \|'),)),
    Figure(LIMITS, "the camera's height above the road it is # px", 'without_turns', (
        found(rf'\| kitti03 \| 10 \| 10 s \| {HEIGHT} \|.*? ± ([\d.]+) \|'),)),
    Figure(LIMITS, 'the readout was # ms instead of 10, and fx # % off: accepted, with a '
           'warning (@)', 'variable_rate', (
               found(r'\| 10 ms, variable rate, by its mean \| accepted \| ([\d.]+) '
                     r'[^|]*\|[^|]*\| [+-]([\d.]+) '),)),
    Figure(LIMITS, 'fx was up to # % and a parameter # sigma off (@)', 'attacks', tuple(
        cell('H.264, 0.03 bits per pixel', column) for column in (
            'worst fx % of those accepted', 'worst error, sigmas'))),
    Figure(LIMITS, 'is found within three turns in # to # % of simulated drives (@)', 'monitor', (
        cell('kitti03, seed 0', 'zoom +2 %', r'[\d.]+'),
        cell('kitti03, seed 0', 'zoom -2 %', r'[\d.]+'))),
)


def pages(parts: str | None = None) -> tuple[dict[str, str], list[str]]:
    """Return the text of each page with the tables' figures, and what is wrong with the places.

    parts: the list of parts for benchmark/README.md.
    """
    texts = {name: (ROOT / name).read_text('utf-8')
             for name in dict.fromkeys(figure.page for figure in FIGURES)}
    wrong = []
    for figure in FIGURES:
        try:
            texts[figure.page] = figure.with_figures(texts[figure.page])
        except ValueError as error:
            wrong.append(str(error))
    texts = {name: with_commits(text) for name, text in texts.items()}
    if parts is not None:
        name = 'benchmark/README.md'
        before, _, rest = (ROOT / name).read_text('utf-8').partition(PARTS[0])
        after = rest.partition(PARTS[1])[2]
        texts[name] = f'{before}{PARTS[0]}\n{parts}\n{PARTS[1]}{after}'
    return texts, wrong


def rewrite(parts: str) -> list[str]:
    """Put the figures into the pages; return what is wrong, old commits of README.md too."""
    texts, wrong = pages(parts)
    for name, text in texts.items():
        (ROOT / name).write_text(text, 'utf-8')
    tables = {figure.table for figure in FIGURES if figure.page == README}
    for commit in sorted({commit for table in tables
                          for commit in commits_of(table_of(table)).split(', ')}):
        count = subprocess.run(['git', 'rev-list', '--count', f'{commit}..HEAD'], cwd=ROOT,
                               capture_output=True, text=True, check=False).stdout.strip()
        if count and int(count) > MOST_COMMITS:
            wrong.append(f'{README}: {commit} is {count} commits old, more than {MOST_COMMITS}')
    return wrong
