# SPDX-License-Identifier: Apache-2.0
"""Whatever bytes and stamps come from outside: a value or an InputError, nothing else."""
from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from dashcalib_ros.errors import InputError
from dashcalib_ros.input.decode import (
    BitDepth,
    decode,
    decode_file,
    encoded_size,
    message_size,
)
from dashcalib_ros.input.motion import NAMES, sensor_stream
from dashcalib_ros.input.motion_files import read_motion
from dashcalib_ros.input.source import LAST_NS, Frame, by_name, is_bag_file
from dashcalib_ros.input.stamps import StampGate
from dashcalib_ros.limits import parse_yaml

QUICK = settings(derandomize=True, deadline=None, max_examples=150, database=None)
STARTS = (b'', b'\xff\xd8', b'\xff\xd8\xff\xc0\0\x11\x08', b'\x89PNG\r\n\x1a\n', b'BM', b'II*\0',
          b'MM\0*', b'P5 ', b'P6\n#', b'RIFF\0\0\0\0WEBPVP8 ', b'RIFF\0\0\0\0WEBPVP8L',
          b'RIFF\0\0\0\0WEBPVP8X')
FILES = st.builds(bytes.__add__, st.sampled_from(STARTS), st.binary(max_size=300))
STAMPS = st.integers(0, 2**40) | st.integers(-2**31 * 10**9, 2**31 * 10**9) | st.just(0)


@QUICK
@given(FILES)
def test_the_size_of_any_bytes(data: bytes) -> None:
    size = encoded_size(memoryview(data))
    assert size is None or (len(size) == 2 and min(size) >= 0)


@QUICK
@given(st.sampled_from(['.jpg', '.png', '.webp', '.bmp', '.tif', '.pgm', '.ppm']),
       st.integers(1, 70), st.integers(1, 70), st.booleans(),
       st.lists(st.tuples(st.integers(0, 40) | st.integers(0, 5000), st.integers(0, 255)),
                max_size=3))
def test_no_picture_is_larger_than_it_says(kind: str, width: int, height: int, grey: bool,
                                           damage: list[tuple[int, int]]) -> None:
    grey = (grey or kind == '.pgm') and kind != '.ppm'
    noise = np.random.default_rng(width).integers(
        0, 256, (height, width) if grey else (height, width, 3), np.uint8)
    data = bytearray(cv2.imencode(kind, noise)[1].tobytes())
    for place, value in damage:
        data[place % len(data)] = value
    size = encoded_size(memoryview(data))
    assert damage or size == (width, height)
    try:
        shown = decode_file(bytes(data)).shape
    except InputError as error:
        assert damage and '\n' not in str(error)
        return
    assert size is not None and shown[1] <= size[0] and shown[0] <= size[1]


@QUICK
@given(FILES, st.sampled_from(['jpeg', 'bgr8; png compressed', '', 'h264', 'compressedDepth']),
       st.booleans())
def test_a_compressed_message_of_any_bytes(data: bytes, kind: str, colour: bool) -> None:
    message = SimpleNamespace(format=kind, data=data)
    try:
        width, height = message_size(message)
        assert decode(message, BitDepth(), colour).dtype == np.uint8
        assert min(width, height) > 0
    except InputError as error:
        assert '\n' not in str(error)


@QUICK
@given(st.sampled_from(['mono8', 'rgb8', 'MONO16', 'nv12', 'yuv422', 'bayer_rggb8', 'none', '']),
       *(st.integers(-3, 9) | st.sampled_from([2**31, 2**32 - 1]) for _ in range(3)),
       st.integers(0, 1), st.binary(max_size=200), st.booleans())
def test_a_raw_message_of_any_fields(encoding: str, width: int, height: int, step: int,
                                     bigendian: int, data: bytes, colour: bool) -> None:
    message = SimpleNamespace(encoding=encoding, width=width, height=height, step=step,
                              is_bigendian=bigendian, data=data)
    try:
        assert decode(message, None, colour).shape[:2] == (height, width)
    except InputError as error:
        assert '\n' not in str(error)


@QUICK
@given(st.lists(st.tuples(STAMPS, STAMPS), max_size=40))
def test_stamps_of_a_recording_increase(stamps: list[tuple[int, int]]) -> None:
    gate = StampGate()
    used = [time for each in stamps if (time := gate.take(*each)) is not None]
    assert used == sorted(set(used))
    assert all('\n' not in str(line) for line in gate.warnings())


@QUICK
@given(st.lists(st.tuples(STAMPS, STAMPS), max_size=40))
def test_every_image_of_a_recording_is_used_or_counted(stamps: list[tuple[int, int]]) -> None:
    gate = StampGate()
    used = sum(gate.take(*each) is not None for each in stamps)
    assert used + gate.repeated == len(stamps) and gate.zero == 0


@QUICK
@given(st.lists(st.integers(1, 2**62), unique=True).map(sorted))
def test_stamps_that_increase_stay_as_they_are(stamps: list[int]) -> None:
    gate = StampGate()
    assert [gate.take(stamp, 5) for stamp in stamps] == stamps
    assert gate.warnings() == []


@QUICK
@given(st.lists(st.tuples(STAMPS, STAMPS), max_size=40), st.floats(0.1, 100))
def test_a_live_gate_gives_the_stamps_it_was_given(stamps: list[tuple[int, int]],
                                                   rate: float) -> None:
    gate = StampGate(rate)
    for header_ns, received_ns in stamps:
        assert gate.take(header_ns, received_ns) in (None, header_ns, received_ns)


@QUICK
@given(st.one_of(st.integers(), st.floats(), st.none(), st.text(max_size=9)))
def test_a_frame_of_any_stamp(stamp: object) -> None:
    try:
        frame = Frame(0, stamp, np.zeros((1, 1), np.uint8))  # type: ignore[arg-type]
        assert abs(frame.stamp_ns) <= LAST_NS
    except InputError as error:
        assert '\n' not in str(error)


@QUICK
@given(st.lists(st.text(max_size=12), max_size=6))
def test_names_of_any_kind_have_an_order(names: list[str]) -> None:
    assert sorted(sorted(names, key=by_name, reverse=True), key=by_name) == sorted(
        names, key=by_name)
    assert not any(is_bag_file(f'{name}.png') for name in names)


NUMBERS = st.floats(allow_nan=True, allow_infinity=True, width=32)


@QUICK
@given(st.sampled_from(sorted(NAMES)), st.lists(st.tuples(NUMBERS, NUMBERS), max_size=30))
def test_samples_of_any_sensor(kind: str, rows: list[tuple[float, float]]) -> None:
    stamps = np.array([stamp for stamp, _ in rows], float)
    values = np.array([[value] * 3 for _, value in rows], float).reshape(-1, 3)
    stream = sensor_stream({kind: (stamps, values)}, 'a test')
    samples = stream.kinds.get(kind)
    unused = [each for each in stream.warnings if each.code == 'E-MOTION-NOT-USED']
    thinned = [each for each in stream.warnings if each.code == 'E-MOTION-STAMPS-EQUAL']
    assert (samples is None) == (len(unused) == 1) and not (unused and thinned)
    if samples is not None:
        assert (np.diff(samples.stamps_s) > 0).all() and np.isfinite(samples.values).all()
        # places are in degrees, and those of no fix are left out
        if kind == 'position':
            rows = [row for row in rows if not (row[1] == 0 or abs(row[1]) > 90)]
            assert set(samples.stamps_s) <= {stamp for stamp, _ in rows}
        else:
            assert set(zip(samples.stamps_s, samples.values[:, 0], strict=True)) <= set(rows)
        assert thinned or len(samples.stamps_s) >= 0.8 * len(rows)


@QUICK
@given(st.text(max_size=60) | st.lists(
    st.sampled_from(['stamp_s', 'gyro_x', 'gyro_y', 'gyro_z', 'speed', 'latitude', 'longitude',
                     'altitude', '0.1', '1e9', 'nan', '', ' 7', 'x', ',', ',', '\n', '\n']),
    max_size=40).map(lambda cells: 'stamp_s,speed,' + ','.join(cells)))
def test_a_csv_of_any_text(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    path = tmp_path_factory.getbasetemp() / 'any.csv'
    path.write_text(text, 'utf-8', 'replace')
    try:
        stream = read_motion(path)
        assert not stream.empty or stream.warnings
    except InputError as error:
        assert len(str(error).splitlines()) == 1


PLAIN = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(allow_nan=False),
                  st.text(max_size=9))
NESTED = st.recursive(PLAIN, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(
    st.text(max_size=4), inner, max_size=4), max_leaves=20)


@QUICK
@given(NESTED, st.lists(st.tuples(st.integers(0, 200), st.sampled_from('[]{}:-&*!#\n 1a')),
                        max_size=3))
def test_yaml_is_what_it_was_or_an_error(content: object, damage: list[tuple[int, str]]) -> None:
    text = yaml.safe_dump([content, content])
    for place, sign in damage:
        place %= len(text)
        text = text[:place] + sign + text[place + 1:]
    try:
        expected = yaml.load(text, getattr(yaml, 'CSafeLoader', yaml.SafeLoader))
    except Exception:
        with pytest.raises(InputError):
            parse_yaml(text, 'it')
        return
    try:
        found = parse_yaml(text, 'it')
    except InputError as error:
        assert damage and error.code in ('E-YAML-TOO-LARGE', 'E-YAML-NUMBER')
        return
    assert found == expected
