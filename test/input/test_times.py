# SPDX-License-Identifier: Apache-2.0
"""Times and order of the images of a folder: by names, lists and numbers."""
from __future__ import annotations

from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest
from made_drives import drive, images, write_bag, write_folder

from dashcalib_ros.errors import InputError
from dashcalib_ros.input.folder import FolderSource, times_of
from dashcalib_ros.input.inputs import open_frames
from dashcalib_ros.input.source import by_name
from dashcalib_ros.input.times import paired, rising, stamps_in

BEGIN = 1_467_394_337_801_095_936
# 20 Hz with some jitter, and a hole of 1 s
TIMES = np.cumsum([0, *[50, 51, 50, 49, 50, 50, 52] * 3, 1050, *[50, 49, 50] * 4]) * 1_000_000


def date(ns: int, text: str) -> str:
    when = datetime.fromtimestamp(0, timezone.utc) + timedelta(microseconds=ns // 1000)
    return when.strftime(text)


NAMINGS = {
    'ns': lambda ns: f'{BEGIN + ns}', 'us': lambda ns: f'{(BEGIN + ns) // 1000}',
    'ms': lambda ns: f'cam0_{(BEGIN + ns) // 10**6}',
    's': lambda ns: f'{(BEGIN + ns) / 10**9:.6f}',
    's, short': lambda ns: f'{(BEGIN // 10**9 * 10**9 + ns) / 10**9:.3f}'.rstrip('0').rstrip('.'),
    'ROS': lambda ns: f'{(BEGIN + ns) // 10**9}_{(BEGIN + ns) % 10**9}',
    'ROS, with zeros': lambda ns: f'{(BEGIN + ns) // 10**9}-{(BEGIN + ns) % 10**9:09}',
    'counted, too': lambda ns: f'{ns // 10**7:06}_{(BEGIN + ns) // 1000}',
    'a date': lambda ns: date(BEGIN + ns, '%Y-%m-%d_%H-%M-%S-%f'),
    'a short date': lambda ns: date(BEGIN + ns, 'IMG_%Y%m%d_%H%M%S%f')[:-3],
    'nuScenes': lambda ns: (f'n015-2018-07-24-11-{22 + ns // 10**10 % 2}-45+0800__CAM_FRONT__'
                            f'{(BEGIN + ns) // 1000}'),
    'Argoverse': lambda ns: f'ring_front_center_{BEGIN + ns}',
    'uptime in ns': lambda ns: f'{98_765_432_109_876 + ns}',
    'uptime in us': lambda ns: f'{(98_765_432_109_876 + ns) // 1000}',
    'uptime in s': lambda ns: f'frame{(12_345_678_901 + ns) / 10**9:.4f}',
}


@pytest.mark.parametrize('naming', NAMINGS)
def test_names_that_are_stamps_are_the_times(naming):
    names = [f'{NAMINGS[naming](int(ns))}.png' for ns in TIMES]
    shuffled = sorted(sorted(names)[::-1], key=by_name)
    found = times_of(Path('/nowhere/images'), shuffled, None)
    assert found.names == names and found.recorded
    np.testing.assert_allclose(np.array(found.stamps_ns) - found.stamps_ns[0], TIMES, atol=1.1e6)
    [told] = found.notices
    assert told.code == 'E-TIMES-READ' and '20 images per second' in str(told)
    if 'uptime' not in naming and 'short' not in naming:
        assert abs(found.stamps_ns[0] - BEGIN) < 10**6
    # they have holes, of which a rate knows nothing
    ignored = times_of(Path('/nowhere/images'), shuffled, 20.0)
    assert ignored.stamps_ns == found.stamps_ns
    assert [each.code for each in ignored.notices] == ['E-FPS-IGNORED']


@pytest.mark.parametrize('name', [
    '{:06}', '{}', 'frame_{:04}0', '2011_09_26_drive_0001_{:010}', '20231115_170400_{:04}',
    'clip1.{:03}', 'GX01{:04}', '1467394337_{:03}', '160701{:03}'])
def test_counted_names_are_no_stamps(name):
    assert stamps_in([name.format(n) for n in range(90)]) is None
    found = times_of(Path('/nowhere/images'), [f'{name.format(n)}.png' for n in range(90)], 10.0)
    assert found.notices == () and found.stamps_ns == [n * 10**8 for n in range(90)]


def test_numbers_of_two_parts_are_no_fractions():
    assert stamps_in([f'{n // 50 + 1}.{n % 50 + 1:02}' for n in range(200)]) is None
    assert stamps_in([f'{n // 12 + 1}.{n % 12 + 1}' for n in range(48)]) is None


def test_milliseconds_without_a_date_are_only_times_without_a_rate():
    names = [f'{round(n * 33.34):06}.jpg' for n in range(60)]
    found = times_of(Path('/nowhere/images'), names, None)
    assert found.stamps_ns[3] == 100_000_000 and 'milliseconds' in str(found.notices[0])
    assert times_of(Path('/nowhere/images'), names, 15.0).stamps_ns[3] == 200_000_000


def test_missing_numbers_keep_their_time():
    names = [f'left_{n:06}.jpg' for n in range(0, 90, 3) if n not in (30, 33, 60)]
    found = times_of(Path('/nowhere/images'), names, 10.0)
    assert np.diff(found.stamps_ns).tolist().count(100_000_000) == len(names) - 3
    assert found.stamps_ns[-1] == 2_900_000_000 and found.length_ns == 3_000_000_000
    [told] = found.notices
    assert told.code == 'E-IMAGES-MISSING'
    assert '3 images' in str(told) and 'left_000027.jpg' in str(told)


def test_numbers_without_a_step_are_named():
    names = [f'{n:06}.jpg' for n in np.cumsum(np.random.default_rng(0).integers(2, 40, 50))]
    found = times_of(Path('/nowhere/images'), names, 10.0)
    assert found.stamps_ns[-1] == 4_900_000_000
    assert [each.code for each in found.notices] == ['E-NUMBERS-UNEVEN']


def test_a_name_is_before_its_copies():
    right = [f'IMG_20231115_17040{second}{copy}.jpg' for second in range(4)
             for copy in ('', *(f' ({n})' for n in range(1, 12)))]
    assert sorted(sorted(right), key=by_name) == right
    others = ['a.mp4', 'a(1).mp4', 'a(10).mp4', 'b~2.db3.zstd', 'b~10.db3.zstd', 'c 1.5', 'c 1.25']
    assert sorted(others[::-1], key=by_name) == others
    # whole seconds tell the rate, but not each image's time
    found = times_of(Path('/nowhere/images'), right, None)
    assert found.stamps_ns[1] == round(1e9 / 12) and found.begin_s == 1_700_067_840
    assert [each.code for each in found.notices] == ['E-RATE-NAMED']
    assert times_of(Path('/nowhere/images'), right, 10.0).notices == ()


SECONDS = [f'{ns / 1e9:.6f}' for ns in TIMES]
NUMBERS = [f'{n:010}' for n in range(len(TIMES))]
LISTS = {
    # file, its lines, and the names of the images without their ending
    '../timestamps.txt': ([date(BEGIN + int(ns), '%Y-%m-%d %H:%M:%S.%f000') for ns in TIMES],
                          NUMBERS),
    'zones.csv': (['name;when is the time',
                   *(f'{n}.png;{date(BEGIN + int(ns), "%Y-%m-%dT%H:%M:%S.%f")}+02:00'
                     for n, ns in zip(NUMBERS, TIMES, strict=True))], NUMBERS),
    '../data.csv': (['#timestamp [ns],filename',
                     *(f'{BEGIN + ns},{n}.png' for n, ns in zip(NUMBERS, TIMES, strict=True))],
                    NUMBERS),
    '../times.txt': ([f'{ns / 1e9:e}' for ns in TIMES], NUMBERS),
    '../images.csv': (['index,stamp_s', *(f'{n},{s}' for n, s in enumerate(SECONDS))], NUMBERS),
    '../rgb.txt': (['# color images', "# file: 'a.bag'", '# timestamp filename', *(
        f'13{n} images/{m}.png' for n, m in zip(
            [f'05031102.{s[2:]}' if s[0] == '0' else f'0503110{2 + int(s[0])}.{s[2:]}'
             for s in SECONDS], NUMBERS, strict=True))], NUMBERS),
    'frames.tsv': (['frame\ttime_ms', *(f'{n}\t{float(s) * 1e3:.3f}'
                                        for n, s in enumerate(SECONDS))], NUMBERS),
    'times.csv': ([f'{BEGIN // 1000 + ns // 1000} 1' for ns in TIMES], NUMBERS),
    'any.txt': ([f'{n} {BEGIN + ns} 0.5' for n, ns in zip(
        [f'f{chr(97 + n // 9)}{n}' for n in range(len(TIMES))], TIMES, strict=True)],
        [f'f{chr(97 + n // 9)}{n}' for n in range(len(TIMES))])}


def folder_of(tmp_path, stems):
    """Return a folder of empty files with these names."""
    folder = tmp_path / 'images'
    folder.mkdir()
    for stem in stems:
        (folder / f'{stem}.png').touch()
    return folder


@pytest.mark.parametrize('file', LISTS)
def test_a_list_beside_the_images_has_their_times(tmp_path, file):
    lines, stems = LISTS[file]
    folder = folder_of(tmp_path, stems)
    (folder / file).write_text('\n'.join(lines) + '\n')
    source = FolderSource(folder)
    assert source._names == [f'{stem}.png' for stem in stems]
    np.testing.assert_allclose(np.array(source._stamps_ns) - source._stamps_ns[0], TIMES,
                               atol=1001)
    assert source.recorded == (source._stamps_ns[0] != 0)
    [told] = source.warnings
    assert told.code == 'E-TIMES-READ' and Path(file).name in str(told)
    assert [each.code for each in FolderSource(folder, fps=10.0).warnings] == ['E-FPS-IGNORED']


@pytest.mark.parametrize('file', LISTS)
def test_a_list_that_is_given_may_be_anywhere(tmp_path, file):
    lines, stems = LISTS[file]
    folder, path = folder_of(tmp_path, stems), tmp_path / 'far' / f'imu_{Path(file).name}'
    path.parent.mkdir()
    path.write_text('\n'.join(lines) + '\n')
    source = open_frames(folder, stamps=path)
    np.testing.assert_allclose(np.array(source._stamps_ns) - source._stamps_ns[0], TIMES,
                               atol=1001)
    path.write_text('1 2\n3 4\n')
    with pytest.raises(InputError) as raised:
        open_frames(folder, stamps=path)
    assert raised.value.code == 'E-STAMPS-UNUSED'
    with pytest.raises(InputError) as raised:
        open_frames([folder, folder], stamps=path)
    assert raised.value.code == 'E-STAMPS-NO-FOLDER'


def test_a_list_pairs_by_number_where_images_are_missing(tmp_path):
    folder = folder_of(tmp_path, [each for n, each in enumerate(NUMBERS) if n not in (3, 4, 20)])
    (tmp_path / 'timestamps.txt').write_text('\n'.join(
        '' if n == 20 else date(BEGIN + int(ns), '%Y-%m-%d %H:%M:%S.%f')
        for n, ns in enumerate(TIMES)))
    found = FolderSource(folder)._stamps_ns
    np.testing.assert_allclose(np.array(found) - found[0], np.delete(TIMES, [3, 4, 20]), atol=1001)


@pytest.mark.parametrize(('file', 'text'), [
    ('../odom.csv', 'stamp_s,speed\n' + '\n'.join(f'{s},1' for s in SECONDS)),
    ('../gps_times.txt', '\n'.join(SECONDS)), ('../notes.txt', '\n'.join(SECONDS)),
    ('times.txt', '1e999\n' * len(NUMBERS)),
    ('labels.csv', 'file,x\n' + '\n'.join(f'{n}.png,{n}' for n in NUMBERS)),
    ('labels.txt', '\n'.join(f'{n}.png 0.{m % 7}5' for m, n in enumerate(NUMBERS)))])
def test_other_files_are_no_lists_of_times(tmp_path, file, text):
    folder = folder_of(tmp_path, NUMBERS)
    (folder / file).write_text(text)
    assert FolderSource(folder, fps=10.0).warnings == ()
    assert FolderSource(folder)._stamps_ns[1] == 100_000_000


@pytest.mark.parametrize('text', [
    '\n'.join(SECONDS[:-5]), '\n'.join(map(str, range(len(NUMBERS)))), 'a b\n1 e\n2 f\n',
    '\n'.join(SECONDS[::-1]), '9' * 5000 + '\n1\n2\n'])
def test_a_list_of_times_that_is_of_no_use_is_named(tmp_path, text):
    folder = folder_of(tmp_path, [f'x{n}' for n in NUMBERS] if 'a b' in text else
                       [f'{chr(97 + n // 9)}{n}' for n in range(len(NUMBERS))])
    (tmp_path / 'times.txt').write_text(text)
    source = FolderSource(folder, fps=10.0)
    assert [each.code for each in source.warnings] == ['E-TIMES-UNUSED']
    assert 'times.txt' in str(source.warnings[0]) and source._stamps_ns[1] == 100_000_000


def test_images_that_a_list_lacks_are_skipped_and_said(tmp_path):
    folder = folder_of(tmp_path, NUMBERS)
    (folder / 'data.csv').write_text('\n'.join(
        f'{BEGIN + ns},{n}.png' for m, (n, ns) in enumerate(zip(NUMBERS, TIMES, strict=True))
        if m != 5))
    source = FolderSource(folder)
    assert source.count == len(TIMES) - 1
    assert [each.code for each in source.warnings] == ['E-TIMES-READ', 'E-IMAGES-UNTIMED']


def test_a_folder_with_times_of_day_is_read_as_a_bag_is(tmp_path):
    frames = drive(12)
    folder = write_folder(tmp_path / 'images', frames)
    for n, file in enumerate(sorted(folder.iterdir())):
        file.rename(folder / f'{frames[n].stamp_ns}.png')
    source, bag = open_frames(folder), open_frames(write_bag(tmp_path / 'bag', images(frames)))
    stamps = [frame.stamp_ns for frame in bag]
    assert [frame.stamp_ns for frame in source] == stamps
    part = source.excerpt(0.35, 0.3)
    assert [frame.stamp_ns for frame in part] == [
        frame.stamp_ns for frame in bag.excerpt(0.35, 0.3)]
    assert set(source.in_colour({3: stamps[3], 7: stamps[7]})) == {3, 7}
    # two of them are joined by their stamps
    both = open_frames([folder, bag.name])
    assert len(list(both)) == 24 and both.begin_ns == stamps[0]


def test_the_longest_part_that_rises():
    assert rising([1, 2, 3]) == [0, 1, 2] and rising([]) == []
    assert rising([9, 1, 2, 3]) == [1, 2, 3] and rising([1, 2, 9, 3, 4]) == [0, 1, 3, 4]
    assert rising([1, 1, float('nan'), 2]) == [0, 3]
    # a clock that was set back: the first part
    assert rising([1, 2, 3, 1, 2, 3]) == [0, 1, 2]


@pytest.mark.parametrize(('numbers', 'lines', 'right'), [
    ([0, 1, 3], [5, 6, None, 7], [5, 6, 7]), ([0, 1, 3], [5, 6, 7], [5, 6, 7]),
    ([1, 2, 3], [5, 6, 7], [5, 6, 7]), ([1, 2, 3], [5, 6, 7, 8], [6, 7, 8]),
    ([0, 1, 2], [5, None, 6, 7], [5, 6, 7]), ([7, 8], [5, 6, 7], None),
    ([None, None], [5, 6], [5, 6]), ([None, None], [5, 6, 7], None),
    ([100, 101, 102], [5, 6, 7], [5, 6, 7])])
def test_lines_are_paired_by_number_or_by_place_or_not_at_all(numbers, lines, right):
    assert paired(numbers, lines) == right
