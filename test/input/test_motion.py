# SPDX-License-Identifier: Apache-2.0
"""Motion streams from files, bags and live samples."""
from __future__ import annotations

import struct
import sys
import tracemalloc
from datetime import datetime, timezone
from types import SimpleNamespace

import numpy as np
import pytest
from made_drives import ROS2, START, drive, head, image, images, write_bag, write_timed
from made_gopro import gopro
from refused import refused

from dashcalib_ros.errors import InputError
from dashcalib_ros.input import motion_files, mp4_sensors
from dashcalib_ros.input.inputs import open_frames
from dashcalib_ros.input.motion import (
    DEGREE_M,
    Samples,
    SensorBuffer,
    SensorStream,
    local_metres,
    sensor_stream,
    speed_sigma,
    speeds_of,
)
from dashcalib_ros.input.motion_files import bag_motion, read_motion
from dashcalib_ros.limits import LINE, read_lines
from dashcalib_ros.session import open_drive

NONE: dict[str, str | None] = {}


def write(path, text):
    path.write_text(text)
    return path


def gyro_csv(path, change=lambda rows: rows):
    rows = [f'{0.01 * n:.2f},0.1,0.2,0.3' for n in range(50)]
    return write(path / 'imu.csv', '\n'.join(['stamp_s,gyro_x,gyro_y,gyro_z', *change(rows)]))


def test_a_csv_has_any_of_its_columns_in_any_order(tmp_path):
    path = write(tmp_path / 'all.csv', 'speed,stamp_s,latitude,longitude,gyro_z,gyro_y,gyro_x\n'
                 + '\n'.join(f'{n},{n / 10},49.0,{8 + n * 1e-5},3,2,{n / 10}' for n in range(20)))
    found = read_motion(path)
    assert found.warnings == () and not found.absolute
    np.testing.assert_allclose(found.rate.values[5], [0.5, 2.0, 3.0])
    np.testing.assert_allclose(found.speed.values[:, 0], np.arange(20))
    east = 1e-5 * 111_320 * np.cos(np.radians(49))
    np.testing.assert_allclose(found.position.values[:, 0], east * np.arange(20), atol=1e-6)


def test_sensors_of_different_rates_leave_cells_empty(tmp_path):
    path = write(tmp_path / 'two.csv', 'stamp_s,gyro_x,gyro_y,gyro_z,latitude,longitude\n'
                 + '\n'.join(f'{n / 10},0,0,1,,' if n % 10 else f'{n / 10},,,,49.0,{8 + n / 1e6}'
                             for n in range(50)))
    found = read_motion(path)
    assert found.warnings == ()
    assert len(found.rate.values) == 45 and len(found.position.values) == 5


@pytest.mark.parametrize(('text', 'code', 'values'), [
    ('', 'E-MOTION-HEADER', ['stamp_s', 'gyro_x', '--poses']),
    ('time,gyro_x\n1,2\n', 'E-MOTION-HEADER', ['stamp_s', 'gyro_x', '--poses']),
    ('stamp_s,temperature\n1,2\n', 'E-MOTION-HEADER', ['stamp_s', 'gyro_x', 'sensor']),
    ('stamp_s,gyro_x,gyro_y\n1,2,3\n', 'E-MOTION-COLUMNS', ['gyro_x, gyro_y of gyro_x'])])
def test_what_is_no_csv_of_sensors_is_named(tmp_path, text, code, values):
    with refused(InputError, code, 'bad.csv', *values):
        read_motion(write(tmp_path / 'bad.csv', text))


def test_a_few_damaged_lines_are_left_out(tmp_path):
    def damage(rows):
        return [*rows[:10], 'x,y', rows[5], 'nan,1,2,3', '0.105,inf,0,0', *rows[10:]]
    found = read_motion(gyro_csv(tmp_path, damage))
    assert len(found.rate.stamps_s) == 50 and (np.diff(found.rate.stamps_s) > 0).all()


@pytest.mark.parametrize(('change', 'line'), [
    (lambda rows: rows[::-1], 'out of order'),
    (lambda rows: ['a,b,c,d'] * 40 + rows, 'damaged'),
    (lambda rows: rows[:5], 'damaged'),
    (lambda rows: [row.replace('0.3', '17.2') for row in rows], 'write rad/s')])
def test_a_stream_that_is_damaged_is_not_used_and_told_in_one_line(tmp_path, change, line):
    found = read_motion(gyro_csv(tmp_path, change))
    assert found.rate is None and found.empty
    [warning] = found.warnings
    assert warning.code == 'E-MOTION-NOT-USED'
    assert line in str(warning) and len(str(warning).splitlines()) == 1


def gpx(points):
    return ('<?xml version="1.0"?><gpx version="1.1" creator="x"><trk><trkseg>'
            + ''.join(f'<trkpt lat="49.0" lon="{8 + n * 1e-4}">{time}</trkpt>'
                      for n, time in enumerate(points)) + '</trkseg></trk></gpx>')


def test_a_gpx_has_times_of_day(tmp_path):
    times = [f'<time>2023-11-14T22:13:{20 + n}Z</time>' for n in range(5)]
    found = read_motion(write(tmp_path / 'track.gpx', gpx(times)))
    assert found.absolute
    since = found.since(START / 1e9)
    np.testing.assert_allclose(since.position.stamps_s, np.arange(5.0))
    assert since.warnings == ()
    # pictures without a time of day: it can only be guessed, and that is told
    guessed = found.since(0.0)
    assert guessed.position.stamps_s[0] == 0.0
    assert guessed.warnings[0].code == 'E-MOTION-NO-TIME-OF-DAY'
    assert guessed.since(0.0) == guessed


@pytest.mark.parametrize(('text', 'code'), [
    ('<gpx', 'E-MOTION-GPX'), (gpx(['']), 'E-MOTION-NO-TIMES'),
    ('<!DOCTYPE x [<!ENTITY a "b">]><gpx/>', 'E-MOTION-GPX')])
def test_what_is_no_gpx_with_times_is_named(tmp_path, text, code):
    with refused(InputError, code, 'track.gpx'):
        read_motion(write(tmp_path / 'track.gpx', text))


def test_whole_seconds_at_10_hz_give_one_place_a_second(tmp_path):
    times = [f'<time>2026-09-21T14:13:{n // 10:02}Z</time>' for n in range(600)]
    found = read_motion(write(tmp_path / 'whole.gpx', gpx(times)))
    assert found.position is not None and len(found.position.stamps_s) == 60
    [warning] = found.warnings
    assert warning.code == 'E-MOTION-STAMPS-EQUAL' and f'{tmp_path}/whole.gpx' in str(warning)


def test_stamps_of_another_unit_are_said(tmp_path):
    rows = '\n'.join(f'{1700000000000 + 10 * n},0.1' for n in range(20))
    found = read_motion(write(tmp_path / 'ms.csv', f'#stamp_s, speed\n{rows}\n'))
    [warning] = found.warnings
    assert found.absolute and warning.code == 'E-STAMP-UNIT-ASSUMED'
    assert f'{tmp_path}/ms.csv' in str(warning) and 'milliseconds' in str(warning)
    assert abs(found.speed.stamps_s[-1] - 1700000000.19) < 1e-6
    with refused(InputError, 'E-STAMP-UNIT', 'odd.csv', '1e+40'):
        read_motion(write(tmp_path / 'odd.csv', 'stamp_s,speed\n1e40,1\n2e40,1\n'))


def test_a_gpx_may_have_any_prefix_fractions_zones_and_damaged_points(tmp_path):
    text = ('<?xml version="1.0" encoding="UTF-8"?><g:gpx xmlns:g="http://example.com/g">'
            '<g:wpt lat="1" lon="1"><g:time>2020-01-01T00:00:00Z</g:time></g:wpt><g:trk>'
            '<g:trkseg><g:trkpt lat="1" lon="1"/>' + ''.join(
                f'<g:trkpt lat="{lat}" lon="8.{n:03d}"><g:ele>1{n}.5</g:ele><x><x y="1">7'
                f'</x></x><g:time> {time} </g:time></g:trkpt>'
                for n, (lat, time) in enumerate([
                    ('49', '2023-11-14T23:13:20.250+01:00'), ('49.1', '2023-11-14T22:13:21.5Z'),
                    *[('49.1', f'2023-11-14T22:13:{n}') for n in range(22, 32)],
                    ('x', '2023-11-14T22:13:40Z'), ('49', '2023-13-99T22:13:41Z')]))
            + '</g:trkseg></g:trk></g:gpx>')
    found = read_motion(write(tmp_path / 'track.gpx', text)).position
    np.testing.assert_allclose(found.stamps_s[:3] - START / 1e9, [0.25, 1.5, 2.0])
    assert len(found.stamps_s) == 12 and found.values[1, 2] == 1.0


def test_more_columns_than_are_used_take_no_memory(tmp_path):
    names = ','.join(['stamp_s', 'speed', *(f'c{n}' for n in range(5000))])
    rows = [f'{n},10' + ',' * 5000 for n in range(20)]
    tracemalloc.start()
    found = read_motion(write(tmp_path / 'wide.csv', '\n'.join([names, *rows, *'x' * 3])))
    assert tracemalloc.get_traced_memory()[1] < 4e6
    tracemalloc.stop()
    assert len(found.speed.values) == 20
    names += ',c' * 2**17
    with refused(InputError, 'E-MOTION-HEADER', 'wide.csv'):
        read_motion(write(tmp_path / 'wide.csv', names[::-1]))


def test_a_line_without_an_end_comes_in_parts(tmp_path):
    path = write(tmp_path / 'long.csv', 'stamp_s,speed\n' + '\n'.join(
        [*(f'{n},10' for n in range(50)), '7' * 3 * LINE]))
    assert len(read_motion(path).speed.values) == 50
    assert max(map(len, read_lines(path, 2**20))) == LINE
    for limit, content in ((100, None), (2**20, b'\xff\xfe')):
        if content:
            path.write_bytes(content)
        with refused(InputError, 'E-FILE-NOT-TEXT' if content else 'E-FILE-TOO-LARGE', path):
            list(read_lines(path, limit))
    with refused(InputError, 'E-FILE-MISSING', 'gone.csv'):
        list(read_lines(tmp_path / 'gone.csv', 10))


@pytest.mark.parametrize('text', [
    '<gpx ' + ' '.join(f'xmlns:n{n}="u{n}"' for n in range(20_000)) + '>',
    '<n:gpx>', '<a>' * 50_000,
    '<!DOCTYPE gpx><gpx></gpx>', '<gpx>' + '<trkpt/>' * 1000 + '</gpx>', '\0',
    '<gpx>' + ''.join(f'<a{n}/>' for n in range(2000)) + '</gpx>',
    '<gpx ' + ' '.join(f'a{n}=""' for n in range(2000)) + '/>'])
def test_a_hostile_gpx_is_one_line(tmp_path, text):
    code = 'E-MOTION-HEADER' if text == '\0' else 'E-MOTION-GPX'
    if '<trkpt/>' in text:
        code = 'E-MOTION-NO-TIMES'
    with refused(InputError, code, 'track.gpx'):
        read_motion(write(tmp_path / 'track.gpx', text))


def test_a_gopro_has_gyro_and_gps_inside(tmp_path):
    pytest.importorskip('telemetry_parser')
    times = np.arange(2000) / 200
    rates = np.stack([0.1 * np.sin(times), np.full(2000, 0.5), -0.2 * np.cos(times)], axis=1)
    (tmp_path / 'GX010001.MP4').write_bytes(gopro(rates, latitude=48.0, speed=10.0))
    found = read_motion(tmp_path / 'GX010001.MP4')
    assert not found.absolute and found.warnings == ()
    np.testing.assert_allclose(found.rate.stamps_s, times, atol=1e-6)
    # the library sorts the axes by the camera's orientation: any mounting is found later
    np.testing.assert_allclose(np.linalg.norm(found.rate.values, axis=1),
                               np.linalg.norm(rates, axis=1), atol=2e-3)
    assert np.ptp(found.position.stamps_s) == pytest.approx(10.0, abs=0.1)
    np.testing.assert_allclose(found.speed.values, 10.0)
    assert np.ptp(found.position.values[:, 1]) > 1.0


@pytest.mark.parametrize('content', [b'', b'\0' * 1000, None])
def test_a_video_without_motion_data_is_named(tmp_path, content):
    pytest.importorskip('telemetry_parser')
    whole = gopro(np.zeros((400, 3)), latitude=48.0, speed=10.0)
    (tmp_path / 'drive.mp4').write_bytes(whole[:len(whole) // 2] if content is None else content)
    try:
        found = read_motion(tmp_path / 'drive.mp4')
    except InputError as error:
        assert 'drive.mp4' in str(error)
    else:
        assert found.empty or found.rate is not None


def test_without_its_reader_the_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, 'telemetry_parser', None)
    with refused(InputError, 'E-MOTION-PARSER', 'drive.mp4', '.[motion]'):
        read_motion(write(tmp_path / 'drive.mp4', 'x'))


@pytest.mark.parametrize('error', [OSError, BaseException])
def test_a_video_on_which_its_reader_fails_is_one_line(tmp_path, monkeypatch, error):
    def panic(path):
        raise error('called `Option::unwrap()`\non a `None` value')
    monkeypatch.setitem(sys.modules, 'telemetry_parser', SimpleNamespace(Parser=panic))
    with refused(InputError, 'E-MOTION-VIDEO', 'drive.mp4'):
        read_motion(write(tmp_path / 'drive.mp4', 'x'))


def test_a_kitti_oxts_folder_counts_from_its_first_image(tmp_path):
    data = tmp_path / 'oxts' / 'data'
    data.mkdir(parents=True)
    for n in range(12):
        values = np.zeros(30)
        values[:2], values[8], values[17:20] = (49.0, 8.0 + n * 1e-5), 7.0, (0.1, 0.2, n / 10)
        write(data / f'{n:010}.txt', ' '.join(map(str, values)) if n != 4 else 'broken')
    write(tmp_path / 'oxts' / 'timestamps.txt', '\n'.join(
        f'2011-09-26 13:02:{25 + n // 10}.{n % 10}00000000' for n in range(12)))
    (tmp_path / 'image_00').mkdir()
    write(tmp_path / 'image_00' / 'timestamps.txt', '2011-09-26 13:02:25.050000000\n')
    for place in (tmp_path, tmp_path / 'oxts'):
        found = read_motion(place).since(0.0)
        assert found.rate.stamps_s[0] == pytest.approx(-0.05, abs=1e-6)
        assert len(found.rate.values) == 11 and found.rate.values[-1].tolist() == [0.1, 0.2, 1.1]
        assert found.speed.values[0, 0] == 7.0
    with refused(InputError, 'E-MOTION-FOLDER', data):
        read_motion(data)
    write(tmp_path / 'oxts' / 'timestamps.txt', 'none\n')
    with refused(InputError, 'E-MOTION-KITTI', 'timestamps.txt'):
        read_motion(tmp_path)
    write(tmp_path / 'oxts' / 'timestamps.txt', '2011-09-26 13:02:25.0\n')
    for path in sorted(data.iterdir())[1:]:
        path.unlink()
    with refused(InputError, 'E-MOTION-KITTI', data, '1 records'):
        read_motion(tmp_path)


def test_records_of_oxts_have_the_time_of_their_number(tmp_path):
    # line 5 is empty, as its record is missing
    there = [n for n in range(30) if n != 5]
    data = tmp_path / 'oxts' / 'data'
    data.mkdir(parents=True)
    for n in there:
        values = np.zeros(30)
        values[17:20] = n / 10
        write(data / f'{n:010}.txt', ' '.join(map(str, values)))
    lines = [f'2011-09-26 13:02:{25 + n // 10}.{n % 10}' for n in range(30)]
    write(tmp_path / 'oxts' / 'timestamps.txt',
          '\n'.join(line if n != 5 else '' for n, line in enumerate(lines)) + '\n')
    found = read_motion(tmp_path).since(0.0).rate
    np.testing.assert_allclose(found.stamps_s, found.values[:, 0], atol=1e-5)
    assert len(found.values) == 29
    # images with times of day of their own; of another clock; and a later part of a drive
    begin = datetime(2011, 9, 26, 13, 2, 26, tzinfo=timezone.utc).timestamp()
    assert read_motion(tmp_path).since(begin).first_s == pytest.approx(-1.0)
    assert read_motion(tmp_path).since(START / 1e9).first_s == pytest.approx(0.0)
    assert read_motion(tmp_path).since(2.0).first_s == pytest.approx(-2.0)
    # a record of no line, and lines of no record
    (data / f'{7:010}.txt').rename(data / f'{70:010}.txt')
    (data / f'{8:010}.txt').unlink()
    with refused(InputError, 'E-MOTION-UNPAIRED', '28 records', '30 lines'):
        read_motion(tmp_path)


@pytest.mark.parametrize('stray', [-7200, -3600, 3600, 86400])
@pytest.mark.parametrize('place', [0, 30, 59])
def test_one_stamp_of_another_clock_costs_one_point(tmp_path, stray, place):
    times = START / 1e9 + np.arange(60.0)
    times[place] += stray
    texts = [f'<time>{datetime.fromtimestamp(each, timezone.utc):%Y-%m-%dT%H:%M:%SZ}</time>'
             for each in times]
    found = read_motion(write(tmp_path / 'track.gpx', gpx(texts)))
    assert len(found.position.stamps_s) == 59 and np.ptp(found.position.stamps_s) < 60
    [told] = found.warnings
    assert told.code == 'E-MOTION-OTHER-CLOCK' and '1 of 60 positions' in str(told)


def by_day(first_s, last_s):
    stamps_s = np.arange(first_s, last_s)
    return SensorStream(rate=Samples(stamps_s, np.zeros((len(stamps_s), 3))), absolute=True)


def test_the_time_of_a_recording_tells_where_a_video_lies_in_a_stream(tmp_path):
    video = write_timed(tmp_path / 'a.mp4', created='2023-11-14T22:13:20.000000Z')
    begin = START / 1e9
    found = open_drive(video, motion=by_day(begin - 30, begin + 60)).motion
    assert found.since(0.0).first_s == -30.0 and found.since(0.0).doubt_s > 1.0
    assert found.since(0.4).first_s == pytest.approx(-30.4) and found.warnings == ()
    # a time zone; and another day, which is no zone
    for later, zone in ((7200, ' 2 h '), (-19800, ' 5.5 h '), (10 * 86400, '')):
        found = open_drive(video, motion=by_day(begin + later - 30, begin + later + 60)).motion
        [told] = found.warnings
        assert told.code == 'E-MOTION-OTHER-DAY' and zone in str(told)
        assert ('zone' in str(told)) == bool(zone) and found.since(0.0).first_s == 0.0
    # several files begin with their first one
    other = write_timed(tmp_path / 'b.mp4', created='2023-11-14T22:14:20.000000Z')
    assert open_drive([video, other], motion=by_day(
        begin - 30, begin + 60)).motion.since(0.0).first_s == -30.0


def test_a_file_counts_from_the_first_image_of_the_whole_drive(tmp_path):
    video = write_timed(tmp_path / 'a.mp4')
    path = gyro_csv(tmp_path)
    assert open_drive(video, motion=path, start_s=0.2).motion.first_s == pytest.approx(-0.2)


def test_images_and_a_file_on_one_uptime(tmp_path):
    folder = tmp_path / 'images'
    folder.mkdir()
    for n in range(20):
        (folder / f'{98_700_000_000 + n * 50_000_000}.png').touch()
    path = write(tmp_path / 'imu.csv', 'stamp_s,speed\n' + '\n'.join(
        f'{90 + n / 10},5' for n in range(200)))
    assert open_drive(folder, motion=path).motion.since(98.7).first_s == pytest.approx(-8.7)


@pytest.mark.parametrize('lost', ['0,0', '91,8', '49,361'])
def test_places_of_no_fix_are_left_out_and_said(tmp_path, lost):
    rows = [f'{n},{lost if n < 30 or n == 45 else f"49,{8 + n * 1e-4}"}' for n in range(60)]
    path = write(tmp_path / 'gps.csv', '\n'.join(['stamp_s,latitude,longitude', *rows]))
    found = read_motion(path)
    assert len(found.position.stamps_s) == 29 and found.position.stamps_s[0] == 30.0
    assert np.ptp(found.position.values[:, 0]) == pytest.approx(29e-4 * DEGREE_M * np.cos(
        np.radians(49)))
    [warning] = found.warnings
    assert warning.code == 'E-GPS-NO-FIX' and f'31 positions of {path}' in str(warning)


def test_a_gps_that_never_had_a_fix_is_not_used(tmp_path):
    path = write(tmp_path / 'gps.csv', 'stamp_s,latitude,longitude\n' + '1,0,0\n2,0,0\n' * 9)
    found = read_motion(path)
    assert found.empty and found.warnings[-1].code == 'E-MOTION-NOT-USED'


def test_the_equator_and_the_meridian_of_greenwich_are_places(tmp_path):
    rows = '\n'.join(f'{n},0,{(n - 5) * 1e-4 + 1e-9}' for n in range(60))
    found = read_motion(write(tmp_path / 'gps.csv', f'stamp_s,latitude,longitude\n{rows}'))
    assert len(found.position.stamps_s) == 60 and found.warnings == ()


def imu(n, topic='/imu', stamp_ns=None, gyro=True):
    types = ROS2.types
    vector = types['geometry_msgs/msg/Vector3']
    none = np.zeros(9)
    message = types['sensor_msgs/msg/Imu'](
        header=head(START + n * 10**7 if stamp_ns is None else stamp_ns, ROS2),
        orientation=types['geometry_msgs/msg/Quaternion'](x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=none, angular_velocity=vector(x=0.1, y=0.2, z=float(n) / 100),
        angular_velocity_covariance=none if gyro else none - np.eye(9)[0],
        linear_acceleration=vector(x=0.0, y=0.0, z=9.8),
        linear_acceleration_covariance=none)
    return topic, START + n * 10**7, message


def fix(n, status=0, place=None):
    types = ROS2.types
    return '/fix', START + n * 10**8, types['sensor_msgs/msg/NavSatFix'](
        header=head(START + n * 10**8, ROS2),
        status=types['sensor_msgs/msg/NavSatStatus'](status=status, service=1),
        latitude=49.0 if place is None else place,
        longitude=8.0 + n * 1e-5 if place is None else place, altitude=float('nan'),
        position_covariance=np.zeros(9), position_covariance_type=0)


def twist(n):
    types = ROS2.types
    vector = types['geometry_msgs/msg/Vector3']
    return '/speed', START + n * 10**8, types['geometry_msgs/msg/TwistStamped'](
        header=head(START + n * 10**8, ROS2), twist=types['geometry_msgs/msg/Twist'](
            linear=vector(x=7.0, y=0.0, z=0.0), angular=vector(x=0.0, y=0.0, z=0.5)))


def test_a_bags_topics_are_found_by_their_type(tmp_path):
    path = write_bag(tmp_path / 'bag', [
        *images(drive(3)), *(imu(n) for n in range(40)), *(fix(n) for n in range(9)),
        fix(9, status=-1), *(twist(n) for n in range(12))])
    found = bag_motion([path], NONE)
    assert found.absolute and found.warnings == ()
    since = found.since(START / 1e9)
    # a gyro is better than what odometry makes of it
    assert since.rate.values.shape == (40, 3) and since.rate.values[0, 0] == 0.1
    assert since.rate.stamps_s[-1] == pytest.approx(0.39, abs=1e-5)
    assert len(since.position.values) == 9 and since.speed.values[0, 0] == 7.0
    alone = write_bag(tmp_path / 'odometry', [twist(n) for n in range(12)])
    assert bag_motion([alone], NONE).rate.values[0].tolist() == [0.0, 0.0, 0.5]


def test_an_imu_without_a_gyro_and_a_gps_without_a_fix_measure_nothing(tmp_path):
    silent = [*(imu(n, gyro=False) for n in range(40)), *(fix(n, status=-1) for n in range(9))]
    found = bag_motion([write_bag(tmp_path / 'bag', silent)], NONE)
    assert found.empty and [each.code for each in found.warnings] == ['E-MOTION-NOT-USED'] * 2
    found = bag_motion([write_bag(tmp_path / 'two', [*silent, *(twist(n) for n in range(12))])],
                       NONE)
    assert found.rate.values[0].tolist() == [0.0, 0.0, 0.5]


def test_without_sensors_a_bag_has_none(tmp_path):
    assert bag_motion([write_bag(tmp_path / 'bag', images(drive(3)))], NONE) is None


def test_of_several_topics_none_is_used_until_one_is_chosen(tmp_path, monkeypatch):
    path = write_bag(tmp_path / 'bag', [
        *(imu(n) for n in range(20)), *(imu(n, '/other') for n in range(20))])
    found = bag_motion([path], NONE)
    [line] = found.warnings
    assert found.empty and line.code == 'E-MOTION-TOPICS' and '/imu, /other' in str(line)
    assert bag_motion([path], {'imu': 'other'}).rate is not None
    monkeypatch.setattr(motion_files, 'SAMPLES', 19)
    [line] = bag_motion([path], {'imu': 'other'}).warnings
    assert line.code == 'E-MOTION-TOO-LONG' and '/other' in str(line)
    with refused(InputError, 'E-BAG-TOPIC-UNKNOWN', "imu topic '/none'", '/imu, /other'):
        bag_motion([path], {'imu': '/none'})


def warmth(n):
    return '/front/warmth', START + n * 10**9, ROS2.types['sensor_msgs/msg/Temperature'](
        header=head(START + n * 10**9, ROS2), temperature=20.0 + n, variance=0.0)


def test_a_temperature_is_used_where_it_is_chosen(tmp_path):
    path = write_bag(tmp_path / 'bag', [*images(drive(3)), *(warmth(n) for n in range(5))])
    assert bag_motion([path], NONE) is None
    found = open_drive(path, temperature='/front/warmth').motion.temperature
    assert found.values[:, 0].tolist() == [20.0, 21.0, 22.0, 23.0, 24.0]
    with refused(InputError, 'E-BAG-TOPIC-UNKNOWN', '/front/warmth'):
        open_drive(path, temperature='/rear')


def test_a_temperature_has_a_file_of_its_own(tmp_path):
    path = write_timed(tmp_path / 'a.mp4')
    file = write(tmp_path / 'warm.csv', 'stamp_s,temperature\n0,20.5\n10,\n20,25\n')
    recording = open_drive(path, temperature=str(file), start_s=0.1)
    assert recording.motion is None and recording.warmth.temperature.values[1] == [25.0]
    np.testing.assert_allclose(recording.warmth.temperature.stamps_s, [-0.1, 19.9])
    # a chip's, beside its rates
    file = write(tmp_path / 'imu.csv', 'stamp_s,speed,temperature\n0,7,45\n1,7,46\n')
    assert open_drive(path, motion=file).motion.temperature is None
    named = open_drive(path, motion=file, columns={'stamp_s': 'stamp_s',
                                                   'temperature': 'temperature'})
    assert named.motion.temperature.values[1] == [46.0]
    kelvins = write(tmp_path / 'kelvins.csv', 'stamp_s,temperature\n0,293\n10,295\n')
    for wrong, code in ((kelvins, 'E-TEMPERATURE-UNUSABLE'),
                        (gyro_csv(tmp_path), 'E-MOTION-COLUMNS'),
                        ('/front/warmth', 'E-TEMPERATURE-MISSING')):
        with refused(InputError, code):
            open_drive(path, temperature=str(wrong))


def test_messages_without_a_stamp_have_the_time_they_came(tmp_path):
    path = write_bag(tmp_path / 'bag', [imu(n, stamp_ns=0) for n in range(20)])
    assert bag_motion([path], NONE).since(START / 1e9).rate.stamps_s[1] == pytest.approx(
        0.01, abs=1e-5)


def test_a_bag_whose_gps_begins_at_0_0(tmp_path):
    path = write_bag(tmp_path / 'bag', [*(fix(n, place=0.0) for n in range(10)),
                                        *(fix(n) for n in range(10, 20))])
    found = bag_motion([path], NONE)
    assert len(found.position.values) == 10 and found.warnings[0].code == 'E-GPS-NO-FIX'
    assert '10 positions' in str(found.warnings[0])
    assert found.since(START / 1e9).position.stamps_s[0] == pytest.approx(1.0, abs=1e-5)


UPTIME = 1234 * 10**9


@pytest.mark.parametrize(('seen', 'felt'), [
    (UPTIME, START), (START, UPTIME), (UPTIME, 9 * UPTIME), (0, UPTIME)])
def test_images_and_sensors_of_different_clocks_are_aligned_by_reception(tmp_path, seen, felt):
    # the first image comes 0.35 s after the sensor's first message
    frames = [(topic, at + 350_000_000, image(frame, stamp_ns=seen and seen + n * 10**8))
              for n, (frame, (topic, at, _)) in enumerate(zip(
                  drive(12), images(drive(12)), strict=True))]
    path = write_bag(tmp_path / 'bag', sorted(
        [*frames, *(imu(n, stamp_ns=felt + n * 10**7) for n in range(100))],
        key=lambda each: each[1]))
    source = open_frames(path)
    start_s = next(iter(source)).stamp_ns / 1e9
    found = bag_motion([path], NONE, '/camera').since(start_s)
    np.testing.assert_allclose(found.rate.stamps_s, np.arange(100) / 100 - 0.35, atol=1e-5)
    [line] = found.warnings
    assert line.code == 'E-MOTION-CLOCK' and '/imu' in str(line)


def test_images_and_sensors_of_one_uptime_keep_it(tmp_path):
    frames = [(topic, at, image(frame, stamp_ns=UPTIME + n * 10**8)) for n, (frame, (
        topic, at, _)) in enumerate(zip(drive(12), images(drive(12)), strict=True))]
    # the sensor was ready before the camera
    path = write_bag(tmp_path / 'bag', [
        *frames, *(imu(n, stamp_ns=UPTIME - 10**9 + n * 10**7) for n in range(100))])
    found = bag_motion([path], NONE).since(UPTIME / 1e9)
    assert found.rate.stamps_s[0] == pytest.approx(-1.0) and found.warnings == ()


def test_live_samples_are_bounded_and_in_order():
    buffer = SensorBuffer(length=100)
    assert buffer.stream().empty
    for n in range(1000):
        buffer.add('rate', START / 1e9 + n / 100, (0.0, 0.0, n / 1000))
        if n % 20 == 0:
            buffer.add('rate', START / 1e9 + n / 100, (0.0, 0.0, 9.0))  # doubled
    found = buffer.stream()
    assert 90 <= len(found.rate.values) <= 100 and found.rate.values.max() < 1.0
    assert found.absolute and (np.diff(found.rate.stamps_s) > 0).all()


def test_positions_are_metres_from_the_first_fix_also_at_the_date_line():
    found = local_metres(np.array([np.nan, 0.0, 0.0, 1e-5]), np.array([0.0, 179.99999, -179.99999,
                                                                      179.99999]), np.zeros(4))
    np.testing.assert_allclose(found[1:, :2], [[0, 0], [2.2264, 0], [0, 1.1132]], atol=1e-3)


def test_speed_is_measured_or_comes_from_positions():
    stamps = np.arange(0.0, 20.0, 0.5)
    places = np.column_stack([12.0 * stamps / DEGREE_M, 8 + 9.0 * stamps / DEGREE_M,
                              np.zeros(len(stamps))])
    by_places = speeds_of(sensor_stream({'position': (stamps, places)}, 'a test'))
    assert np.allclose(by_places.values, 15.0) and by_places.stamps_s[0] == 0.5
    backwards = sensor_stream({'speed': (stamps, np.full((len(stamps), 1), -3.0)),
                               'position': (stamps, places)}, 'a test')
    assert np.allclose(speeds_of(backwards).values, 3.0)
    # wheels wear; positions do not
    assert speed_sigma(backwards) > speed_sigma(sensor_stream(
        {'position': (stamps, places)}, 'a test'))
    assert speeds_of(sensor_stream({'position': (stamps[:2], places[:2])}, 'a test')) is None
    assert speeds_of(SensorStream()) is None


def test_a_car_stood_only_where_its_speed_says_so_all_the_time():
    stamps_s = np.arange(0.0, 30.0, 0.1)
    speed = np.where((stamps_s > 10) & (stamps_s < 20), -0.1, 8.0)[:, None]
    stream = SensorStream(speed=Samples(stamps_s, speed))
    assert stream.stood(11.0, 19.0)
    assert not stream.stood(9.0, 19.0) and not stream.stood(31.0, 40.0)
    # odometry that is not wired, and none
    dead = SensorStream(speed=Samples(stamps_s, 0 * speed))
    assert not dead.stood(11.0, 19.0) and not SensorStream().stood(11.0, 19.0)


RATES = [(0.1, 0.2, -0.3), (0.2, 0.1, -0.4)]
EPOCH_NS = 1_700_000_000_000_000_000


def rows(start, step, *values, mark=','):
    """Return 30 lines of a log: its stamps, and the values, which repeat."""
    return [mark.join(map(str, (start + n * step, *(each(n) for each in values))))
            for n in range(30)]


def rate(axis, scale=1.0):
    return lambda n: RATES[n % 2][axis] / scale


LOGS = {
    'Gyroscope.csv': ['time,seconds_elapsed,z,y,x', *rows(
        EPOCH_NS, 10**7, lambda n: n / 100, rate(2), rate(1), rate(0))],
    'phyphox.csv': ['"Time (s)","Gyroscope x (rad/s)","Gyroscope y (rad/s)",'
                    '"Gyroscope z (rad/s)","Absolute (rad/s)"', *rows(
                        0, 0.01, rate(0), rate(1), rate(2), lambda n: 0.4)],
    'comma.csv': ['"Time (s)"\t"Gyroscope x (rad/s)"\t"Gyroscope y (rad/s)"\t'
                  '"Gyroscope z (rad/s)"', *(line.replace('.', ',') for line in rows(
                      0, 0.01, rate(0), rate(1), rate(2), mark='\t'))],
    'data.csv': ['#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],'
                 'a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]', *rows(
                     EPOCH_NS, 10**7, rate(0), rate(1), rate(2), *[lambda n: 9.8] * 3)],
    'gyro_accel.csv': ['Timestamp[nanosec], gx[rad/s], gy[rad/s], gz[rad/s], ax[m/s^2]', *rows(
        5 * 10**12, 10**7, rate(0), rate(1), rate(2), lambda n: 9.8)],
    'fly.gcsv': ['GYROFLOW IMU LOG', 'version,1.3', 'id,logger', 'orientation,YxZ',
                 'tscale,0.001', 'gscale,0.0001', 'ascale,0.1', 't,gx,gy,gz,ax,ay,az', *rows(
                     0, 10, rate(0, 1e-4), rate(1, 1e-4), rate(2, 1e-4), *[lambda n: 1] * 3)]}


@pytest.mark.parametrize('name', LOGS)
def test_the_logs_of_phones_and_loggers(tmp_path, name):
    stream = read_motion(write(tmp_path / name, '\n'.join(LOGS[name])))
    np.testing.assert_allclose(stream.rate.values[:2], RATES, rtol=1e-9)
    np.testing.assert_allclose(np.diff(stream.rate.stamps_s), 0.01, atol=1e-6)
    assert stream.absolute == (name in ('Gyroscope.csv', 'data.csv'))
    start = {'Gyroscope.csv': 1.7e9, 'data.csv': 1.7e9, 'gyro_accel.csv': 5e3}.get(name, 0.0)
    assert stream.rate.stamps_s[0] == pytest.approx(start)


def test_a_folder_of_sensor_logger_has_gyro_and_gps(tmp_path):
    write(tmp_path / 'Gyroscope.csv', '\n'.join(LOGS['Gyroscope.csv']))
    # an accelerometer has the same headings as a gyro
    write(tmp_path / 'Accelerometer.csv', '\n'.join(LOGS['Gyroscope.csv']))
    write(tmp_path / 'Location.csv', '\n'.join([
        'time,seconds_elapsed,speed,altitude,longitude,latitude', *rows(
            EPOCH_NS, 10**9, lambda n: n, lambda n: 10.0, lambda n: 100.0, lambda n: 8.0,
            lambda n: 49 + n / 10**4)]))
    stream = read_motion(tmp_path)
    assert len(stream.rate.stamps_s) == len(stream.position.stamps_s) == 30
    np.testing.assert_allclose(stream.speed.values, 10)
    with pytest.raises(InputError) as raised:
        read_motion(tmp_path / 'Accelerometer.csv')
    assert raised.value.code == 'E-MOTION-HEADER'


def test_columns_of_any_csv_are_named(tmp_path):
    path = write(tmp_path / 'a.csv', '\n'.join([
        't_ms;wx [deg/s];wy [deg/s];wz [deg/s];v_kmh', *rows(
            0, 10, rate(0, np.pi / 180), rate(1, np.pi / 180), rate(2, np.pi / 180),
            lambda n: 36, mark=';')]))
    named = {'stamp_s': 't_ms', 'gyro_x': 'wx [deg/s]', 'gyro_y': 'wy [deg/s]',
             'gyro_z': 'wz [deg/s]', 'speed': 'v_kmh'}
    stream = read_motion(path, named)
    np.testing.assert_allclose(stream.rate.values[:2], RATES)
    np.testing.assert_allclose(stream.rate.stamps_s[:3], [0, 0.01, 0.02])
    np.testing.assert_allclose(stream.speed.values, 10)
    with pytest.raises(InputError) as raised:
        read_motion(path, {**named, 'gyro_x': 'w'})
    assert raised.value.code == 'E-MOTION-COLUMNS' and 'wx' in str(raised.value)


def test_a_whole_hour_is_told_with_its_option(tmp_path):
    path = write(tmp_path / 'Gyroscope.csv', '\n'.join(LOGS['Gyroscope.csv']))
    later = EPOCH_NS + 3600 * 10**9 + 10**8
    [line] = read_motion(path).on_clock_of(later, True, None).warnings[-1:]
    assert line.code == 'E-MOTION-OTHER-DAY' and '--sensor-offset=3600s' in str(line)
    shifted = read_motion(path).shifted(3600.0).on_clock_of(later, True, None)
    assert 'E-MOTION-OTHER-DAY' not in [each.code for each in shifted.warnings]


def novatek_video(path, place, lost=(0, 1)):
    """Write an MP4 with the GPS of 30 s, as a Viofo has it; two seconds without a fix."""
    def box(name, data):
        return struct.pack('>I4s', 8 + len(data), name) + data

    head, blocks = box(b'ftyp', b'isom' + bytes(4)), []
    for n in range(30):
        fix = struct.pack(
            '<6I4s4f', 10, 59 + (30 + n) // 60 - 1, (30 + n) % 60, 26, 11, 27,
            b'V\0\0\0' if n in lost else b'ASW\0', 4807.5 + 0.006 * n, 1131.0, 10.0, 90.0)
        data = b'GPS ' + bytes(place - 12) + fix
        blocks.append(box(b'free', data + bytes(116 - len(data))))
    begin = len(head) + 8
    places = b''.join(struct.pack('>II', begin + 124 * n, 124) for n in range(30))
    places = box(b'gps ', struct.pack('>II', 0, 30) + places)
    movie = box(b'moov', box(b'mvhd', bytes(100)) + places)
    path.write_bytes(head + box(b'mdat', b''.join(blocks)) + movie)
    return path


@pytest.mark.parametrize('place', [16, 48])
def test_the_gps_of_novatek_s_dashcams(tmp_path, place):
    stream = read_motion(novatek_video(tmp_path / 'a.mp4', place))
    # the first fix is of the third second
    np.testing.assert_allclose(stream.position.stamps_s, range(2, 30))
    np.testing.assert_allclose(stream.speed.values, 10 * 1852 / 3600, rtol=1e-5)
    # south of the equator more is farther south: 0.006 minutes a second
    # as far as 4 bytes tell
    np.testing.assert_allclose(np.diff(stream.position.values[:, 1]), -0.0001 * 111_320, atol=1)
    np.testing.assert_allclose(mp4_sensors.novatek_fixes(tmp_path / 'a.mp4')[0][1:3], (
        -(48 + 7.512 / 60), -(11 + 31 / 60)), atol=1e-5)
    assert not stream.absolute and stream.doubt_s > 0


def test_a_damaged_video_of_novatek_s_is_read_as_far_as_it_goes(tmp_path):
    path = novatek_video(tmp_path / 'a.mp4', 48)
    whole = path.read_bytes()
    for cut in (20, 100, 2000, len(whole) - 100, len(whole) - 3):
        path.write_bytes(whole[:cut])
        mp4_sensors.novatek_fixes(path)
    path.write_bytes(whole[:-8] + struct.pack('>II', 2**32 - 1, 2**32 - 1))
    assert len(mp4_sensors.novatek_fixes(path)) == 27
    path.write_bytes(b'')
    assert mp4_sensors.novatek_fixes(path) == []


def camm_video(path, samples, scale=1000, step=100):
    """Write an MP4 with a track of CAMM, two samples in a chunk."""
    def box(name, data):
        return struct.pack('>I4s', 8 + len(data), name) + data

    def table(name, data):
        return box(name, bytes(4) + data)

    head = box(b'ftyp', b'isom' + bytes(4))
    sizes = [len(each) for each in samples]
    starts = [len(head) + 8 + sum(sizes[:n]) for n in range(0, len(samples), 2)]
    stbl = box(b'stbl', b''.join([
        table(b'stsd', struct.pack('>I', 1) + struct.pack('>I4s', 16, b'camm') + bytes(8)),
        table(b'stts', struct.pack('>3I', 1, len(samples), step)),
        table(b'stsc', struct.pack('>4I', 1, 1, 2, 1)),
        table(b'stsz', struct.pack(f'>2I{len(sizes)}I', 0, len(sizes), *sizes)),
        table(b'stco', struct.pack(f'>I{len(starts)}I', len(starts), *starts))]))
    mdhd = table(b'mdhd', struct.pack('>5I', 0, 0, scale, 0, 0))
    trak = box(b'trak', box(b'mdia', mdhd + box(b'minf', stbl)))
    other = box(b'trak', box(b'mdia', box(b'minf', box(b'stbl', table(
        b'stsd', struct.pack('>I', 1) + struct.pack('>I4s', 16, b'avc1') + bytes(8))))))
    path.write_bytes(head + box(b'mdat', b''.join(samples)) + box(b'moov', other + trak))
    return path


def camm_samples():
    samples = []
    for n in range(40):
        samples.append(struct.pack('<2H3f', 0, 2, 0.1, 0.2, 0.01 * n))
        samples.append(struct.pack('<2Hdi2d7f', 0, 6, 1.4e9 + n, 0 if n < 2 else 3, 48.0,
                                   11.0 + 1e-4 * n, 500.0, 1, 1, 3.0, 4.0, 0.0, 1))
        samples.append(struct.pack('<2H3f', 0, 3, 0.0, 0.0, 9.8))
    return samples


def test_gyro_and_gps_of_a_camm_track(tmp_path):
    stream = read_motion(camm_video(tmp_path / 'a.mp4', camm_samples()))
    assert not stream.absolute
    np.testing.assert_allclose(stream.rate.stamps_s, 0.3 * np.arange(40), atol=1e-9)
    np.testing.assert_allclose(stream.rate.values[:, 2], 0.01 * np.arange(40), atol=1e-6)
    # two without a fix
    np.testing.assert_allclose(stream.position.stamps_s, 0.3 * np.arange(2, 40) + 0.1)
    np.testing.assert_allclose(stream.speed.values, 5.0)
    short = [struct.pack('<2H3d', 0, 5, 48.0, 11.0 + 1e-4 * n, 500.0) for n in range(20)]
    found = mp4_sensors.camm_streams(camm_video(tmp_path / 'b.mp4', short))
    assert len(found['position'][0]) == 20


def test_a_damaged_camm_track_is_read_as_far_as_it_goes(tmp_path):
    path = camm_video(tmp_path / 'a.mp4', [*camm_samples(), b'', b'\0', struct.pack(
        '<2H', 0, 2), struct.pack('<2H', 0, 99)])
    assert len(mp4_sensors.camm_streams(path)['rate'][0]) == 40
    whole = path.read_bytes()
    for cut in range(10, len(whole), 97):
        path.write_bytes(whole[:cut])
        mp4_sensors.camm_streams(path)


def test_a_hostile_camm_track_is_bounded_by_its_file(tmp_path):
    path = tmp_path / 'a.mp4'
    path.write_bytes(struct.pack('>I4s', 0, b'moov') + 3000 * struct.pack('>I4s', 0, b'trak'))
    assert not mp4_sensors.camm_streams(path)
    data = camm_video(path, [struct.pack('<2H3f', 0, 2, 0, 0, 1)] * 2).read_bytes()
    most = 2**32 - 1
    for old, new in [(struct.pack('>2I', 0, 2) + 2 * struct.pack('>I', 16),
                      struct.pack('>4I', 16, most, 16, 16)),
                     (struct.pack('>3I', 1, 2, 100), struct.pack('>3I', 1, most, 100)),
                     (struct.pack('>4I', 1, 1, 2, 1), struct.pack('>4I', 1, 1, most, 1))]:
        assert data.count(old) == 1
        data = data.replace(old, new)
    path.write_bytes(data)
    with path.open('rb') as file:
        assert 2 <= sum(1 for _ in mp4_sensors._camm_samples(file, len(data))) <= len(data) // 16
