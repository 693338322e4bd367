# SPDX-License-Identifier: Apache-2.0
"""Times as they are written in names of files and in lists, and which of them belong together."""
from __future__ import annotations

import re
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from decimal import Decimal
from itertools import pairwise
from statistics import median

from dashcalib_ros.input.source import LAST_NS
from dashcalib_ros.input.stamps import SECOND_NS

# a date and a time, part of a second, and zone: 2011-09-26 13:02:25.964389445, 20231115_170400123
DATE = re.compile(
    r'(?<!\d)(?P<y>(?:19|20)\d\d)(?P<apart>[-_.:/]?)(?P<m>\d\d)(?P=apart)(?P<d>\d\d)[-_T .]*'
    r'(?P<H>\d\d)[-_.:h]?(?P<M>\d\d)[-_.:m]?(?P<S>\d\d)'
    r'(?:(?:[.,_s]|(?<!:\d\d)-)?(?P<part>\d{1,9}))?(?P<zone>Z|[+-]\d\d:?\d\d)?(?!\d)')
UNITS = {'seconds': SECOND_NS, 'milliseconds': 10**6, 'microseconds': 1000, 'nanoseconds': 1}
# how headings of columns end that name a unit
UNIT_HEADINGS = {'nanoseconds': r'ns|nsecs?|nano\w*', 'microseconds': r'us|µs|usecs?|micro\w*',
                 'milliseconds': r'ms|msecs?|milli\w*', 'seconds': r's|secs?|seconds?'}
# ns since 1970: from the year 2001 on; numbers and dates of smaller ones look like others
EPOCH_NS = 10**18
# ns between two images of a drive: where the time since 1970 tells the unit, and else, by which
# no two units fit
STEPS_NS, LIKELY_STEPS_NS = (10**6, 60 * SECOND_NS), (5 * 10**6, 2 * SECOND_NS)
# of the median step; others are not regular, of which there must be this share
REGULAR, MOSTLY = (0.5, 1.5), 0.5
# share of names or lines that may lack a time
LACKING = 0.1


def dated(text: str) -> tuple[int, str] | None:
    """Return s since 1970 of a date and time in a text, and the digits of its part of a second.

    UTC where it names no zone; None where there is none.
    """
    found = DATE.search(text)
    if found is None:
        return None
    try:
        year, month, day, hour, minute, second = map(int, found.group(*'ymdHMS'))
        when = datetime(year, month, day, hour, minute, second, tzinfo=timezone.utc)
    except ValueError:
        return None
    zone = (found['zone'] or 'Z').replace(':', '')
    east_s = 0 if zone == 'Z' else int(f'{zone[0]}1') * 60 * (
        60 * int(zone[1:3]) + int(zone[3:]))
    return int(when.timestamp()) - east_s, found['part'] or ''


def dated_ns(text: str) -> int | None:
    """Return ns since 1970 of a date and time in a text, None where there is none."""
    found = dated(text)
    return None if found is None else found[0] * SECOND_NS + int(found[1].ljust(9, '0'))


def unit_of(heading: str) -> str:
    """Return the unit that a heading names, such as 'timestamp [ns]' or stamp_s; '' for none."""
    words = re.findall(r'[a-zµ]+', heading.lower())
    return next((unit for unit, like in UNIT_HEADINGS.items()
                 if words and re.fullmatch(like, words[-1])), '')


def rising(stamps: Sequence[float]) -> list[int]:
    """Return the places of the longest part that rises; of several that of the first ones.

    A stamp of another clock costs itself only. NaN belongs to no part.
    """
    greedy: list[int] = []
    for place, stamp in enumerate(stamps):
        if stamp == stamp and (not greedy or stamp > stamps[greedy[-1]]):
            greedy.append(place)
    if len(greedy) == len(stamps):
        return greedy
    # of the best part of each length: its last stamp, and its place; and what is before each
    ends: list[float] = []
    places: list[int] = []
    before: dict[int, int] = {}
    for place, stamp in enumerate(stamps):
        if stamp != stamp:
            continue
        length = bisect_left(ends, stamp)
        before[place] = places[length - 1] if length else -1
        ends[length:length + 1], places[length:length + 1] = [stamp], [place]
    if len(places) <= len(greedy):
        return greedy
    found = [places[-1]]
    while before[found[-1]] >= 0:
        found.append(before[found[-1]])
    return found[::-1]


def paired(numbers: Sequence[int | None], lines: Sequence[int | None]) -> list[int | None] | None:
    """Return the stamp of each file, by its number or by its place; None where neither fits.

    numbers: of the files, in order, as their names have them. lines: stamps of a list, None for a
    line without one: some recorders leave a line empty whose file is missing, others have none.
    """
    known = [number for number in numbers if number is not None]
    filled = [line for line in lines if line is not None]
    by_number: list[int | None] | None = None
    if known and len(set(known)) == len(numbers):
        first = int(min(known) == 1 and max(known) == len(lines))
        if max(known) - first < len(lines):
            by_number = [lines[number - first] for number in known]
    if by_number is not None and None not in by_number:
        return by_number
    if len(filled) == len(numbers):
        return list(filled)
    if len(lines) == len(numbers):
        return list(lines)
    if by_number is not None and by_number.count(None) <= LACKING * len(numbers):
        return by_number
    return None


@dataclass(frozen=True)
class Stamps:
    """Times of files: ns (n,), None for one without; the unit in words.

    clear: they can be nothing but times.
    """

    ns: tuple[int | None, ...]
    unit: str
    clear: bool = True


def in_ns(values: Sequence[Decimal | None], unit: str = '', listed: bool = True) -> Stamps | None:
    """Return numbers as times of images in ns; None where they cannot be such.

    unit: of UNITS, where it is known; else it is what fits to images since 1970, or to their
    rate. listed: they are in a list of times; numbers in names may also be counted.
    """
    there = sorted(value for value in values if value is not None)
    steps = [b - a for a, b in pairwise(there)]
    if not steps or max(abs(there[0]), abs(there[-1])) > LAST_NS:
        return None
    step, size = median(steps), median(map(abs, there))
    whole = all(value == int(value) for value in there)
    clear = True
    if not unit:
        unit = next((name for name, ns in UNITS.items()
                     if EPOCH_NS <= size * ns <= LAST_NS
                     and STEPS_NS[0] <= step * ns <= STEPS_NS[1]), '')
    if not unit:
        unit = next((name for name, ns in UNITS.items()
                     if LIKELY_STEPS_NS[0] <= step * ns <= LIKELY_STEPS_NS[1]
                     and not (whole and name == 'seconds')), '')
        # counted images of which every nth is there: their steps are multiples of one
        clear = listed or not (whole and unit == 'milliseconds')
        if not clear and not any(each % min(steps) for each in steps if min(steps)):
            return None
    if not unit or max(abs(there[0]), abs(there[-1])) * UNITS[unit] > LAST_NS:
        return None
    return Stamps(tuple(None if value is None else round(value * UNITS[unit]) for value in values),
                  unit, clear)


def stamps_in(stems: Sequence[str]) -> Stamps | None:
    """Return the times that names without their endings are; None where they are none."""
    best: tuple[float, Stamps] | None = None
    for values, unit, parts in _read(stems):
        found = in_ns(values, unit, listed=False)
        if found is None:
            continue
        ns = sorted(each for each in found.ns if each is not None)
        steps = [b - a for a, b in pairwise(ns)]
        middle = median(steps)
        if min(steps) <= 0 or not STEPS_NS[0] <= middle <= STEPS_NS[1]:
            continue
        regular = sum(REGULAR[0] * middle <= step <= REGULAR[1] * middle for step in steps)
        if parts and not (regular >= MOSTLY * len(steps) and _goes_on(ns, found.unit, middle)):
            continue
        if best is None or regular > best[0]:
            best = regular, found
    return None if best is None else best[1]


def _goes_on(ns: Sequence[int], unit: str, middle: float) -> bool:
    """Return whether numbers before and after a dot are one: it goes on where the first rises.

    Numbers of two parts, as 1.01 to 1.50 and then 2.01, begin anew there.
    """
    whole = UNITS[unit] if unit != 'nanoseconds' else SECOND_NS
    over = [b - a for a, b in pairwise(ns) if a // whole != b // whole]
    return bool(over) and sum(step <= 3 * middle for step in over) >= MOSTLY * len(over)


def _read(stems: Sequence[str]) -> Iterator[tuple[list[Decimal | None], str, bool]]:
    """Yield the ways to read names as numbers: these, their unit where known, if of two parts."""
    dates = [dated(stem) for stem in stems]
    coarse = dates.count(None) <= LACKING * len(stems)
    if coarse:
        longest = max(len(date[1]) for date in dates if date)
        # 5 ms may be written _5; and whole seconds are too coarse
        if longest:
            yield ([date and Decimal(date[0]) + Decimal(int(date[1] or 0)).scaleb(-longest)
                    for date in dates], 'seconds', True)
            return
        # nuScenes: the drive's date, and then the image's time
        stems = [DATE.sub('', stem, count=1) for stem in stems]
    split = [re.split(r'(\d+)', stem) for stem in stems]
    # the same text between the numbers; 12 beside 12.5 is one number
    usual, count = Counter(tuple(each[::2]) for each in split).most_common(1)[0]
    if count < len(stems) and not coarse:
        plain = [re.fullmatch(r'(\D*)(\d+(?:\.\d+)?)(\D*)', stem) for stem in stems]
        if None not in plain and len({each.group(1, 3) for each in plain if each}) == 1:
            yield [each and Decimal(each[2]) for each in plain], '', True
            return
    if count < (1 - LACKING) * len(stems):
        return
    groups = list(zip(*(each[1::2] if tuple(each[::2]) == usual else [''] * (len(usual) - 1)
                        for each in split), strict=True))

    def numbers(place: int) -> list[Decimal | None]:
        return [Decimal(text) if text else None for text in groups[place]]

    varying = [place for place, texts in enumerate(groups) if len({*texts, ''}) > 2]
    for place in () if coarse else varying:
        part = place + 1
        if part < len(groups) and usual[part] in ('.', ',', '_', '-'):
            digits = {len(text) for text in groups[part] if text}
            whole, parts = numbers(place), numbers(part)
            if max(digits) <= 9 and (usual[part] in '.,' or len(digits) == 1):
                yield [None if n is None or m is None else n + m.scaleb(-len(text))
                       for n, m, text in zip(whole, parts, groups[part], strict=True)
                       ], '' if usual[part] in '.,' else 'seconds', True
            # seconds and nanoseconds of ROS, which some write without zeros before them
            if max(digits) <= 9 and any(n is not None and n * SECOND_NS >= EPOCH_NS
                                        for n in whole):
                yield [None if n is None or m is None else n + m.scaleb(-9)
                       for n, m in zip(whole, parts, strict=True)], 'seconds', True
    for place in varying:
        # a number that is beside others is a time only where it is one since 1970
        values = numbers(place)
        known = [value for value in values if value is not None]
        if (len(varying) == 1 and not coarse) or any(
                EPOCH_NS <= median(known) * ns <= LAST_NS for ns in UNITS.values()):
            yield values, '', False


def numbers_in(stems: Sequence[str]) -> list[int | None]:
    """Return the number by which names are counted: the only one that changes; None: has none."""
    split = [re.split(r'(\d+)', stem) for stem in stems]
    if len({tuple(each[::2]) for each in split}) > 1:
        return [None] * len(stems)
    changing = [texts for texts in zip(*(each[1::2] for each in split), strict=True)
                if len(set(texts)) > 1]
    return list(map(int, changing[0])) if len(changing) == 1 else [None] * len(stems)
