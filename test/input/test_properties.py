"""Whatever bytes and stamps come from outside: a value or an InputError, nothing else."""
from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from dashcalib_ros.errors import InputError
from dashcalib_ros.input.decode import BitDepth, decode, encoded_size, message_size
from dashcalib_ros.input.source import LAST_NS, Frame, by_name, is_bag_file
from dashcalib_ros.input.stamps import StampGate

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
    assert all('\n' not in line for line in gate.warnings())


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
