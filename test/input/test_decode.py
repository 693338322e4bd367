# SPDX-License-Identifier: Apache-2.0
"""Image messages become the right grey pixels, whatever their encoding."""
import array
import gzip
import struct
import zlib
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import zstandard
from fakes import compressed_message, image_message
from hostile_pictures import QUICK, SLOW, empty_scans
from refused import refused

from dashcalib_ros.errors import InputError
from dashcalib_ros.input.decode import (
    BitDepth,
    decode,
    decode_file,
    encoded_size,
    message_size,
    turned_text,
)
from dashcalib_ros.input.inputs import open_frames

WIDTH, HEIGHT = 8, 6
GREY = (np.arange(WIDTH * HEIGHT, dtype=np.uint8) * 5).reshape(HEIGHT, WIDTH)
RED, GREEN, BLUE = 200, 100, 50
LUMA = 124  # 0.299 * 200 + 0.587 * 100 + 0.114 * 50 = 124.2


def message(encoding, pixels, big=False, padding=0, **changes):
    """Make an Image; pixels is (height, width) or (height, width, channels) of its own dtype."""
    height, width = pixels.shape[:2]
    if pixels.dtype == np.uint16:
        pixels = pixels.astype('>u2' if big else '<u2')
    rows = np.frombuffer(pixels.tobytes(), np.uint8).reshape(height, -1)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=255)
    fields = {'encoding': encoding, 'height': height, 'width': width, 'step': rows.shape[1],
              'is_bigendian': int(big), 'data': array.array('B', rows.tobytes())}
    return image_message(**{**fields, **changes})


def colour(*channels, dtype=np.uint8):
    return np.full((HEIGHT, WIDTH, len(channels)), channels, dtype)


@pytest.mark.parametrize('encoding', ['mono8', '8UC1'])
@pytest.mark.parametrize('padding', [0, 5])
def test_grey_is_taken_as_it_is(encoding, padding):
    image = decode(message(encoding, GREY, padding=padding))
    assert image.dtype == np.uint8
    assert image.flags.c_contiguous
    np.testing.assert_array_equal(image, GREY)


@pytest.mark.parametrize('encoding, channels', [
    ('bgr8', (BLUE, GREEN, RED)), ('8UC3', (BLUE, GREEN, RED)), ('rgb8', (RED, GREEN, BLUE)),
    ('bgra8', (BLUE, GREEN, RED, 9)), ('8UC4', (BLUE, GREEN, RED, 9)),
    ('rgba8', (RED, GREEN, BLUE, 9))])
@pytest.mark.parametrize('padding', [0, 3])
def test_colours_are_weighted_in_their_order(encoding, channels, padding):
    image = decode(message(encoding, colour(*channels), padding=padding))
    np.testing.assert_array_equal(image, np.full((HEIGHT, WIDTH), LUMA))


@pytest.mark.parametrize('encoding, channels', [
    ('bgr16', (BLUE, GREEN, RED)), ('rgb16', (RED, GREEN, BLUE)),
    ('bgra16', (BLUE, GREEN, RED, 9)), ('rgba16', (RED, GREEN, BLUE, 9))])
@pytest.mark.parametrize('big', [False, True])
def test_deep_colours(encoding, channels, big):
    deep = colour(*channels, dtype=np.uint16) * 256
    image = decode(message(encoding, deep, big), BitDepth())
    np.testing.assert_array_equal(image, np.full((HEIGHT, WIDTH), LUMA))


@pytest.mark.parametrize('encoding, luma', [
    ('yuv422', 1), ('uyvy', 1), ('yuv422_yuy2', 0), ('yuyv', 0)])
@pytest.mark.parametrize('padding', [0, 4])
def test_yuv_gives_its_brightness(encoding, luma, padding):
    pixels = np.full((HEIGHT, WIDTH, 2), 77, np.uint8)
    pixels[..., luma] = GREY
    np.testing.assert_array_equal(decode(message(encoding, pixels, padding=padding)), GREY)


@pytest.mark.parametrize('encoding, chroma_rows', [
    ('nv12', HEIGHT // 2), ('nv21', HEIGHT // 2), ('nv24', HEIGHT * 2), ('i420', HEIGHT // 2)])
def test_planar_yuv_gives_its_first_plane(encoding, chroma_rows):
    planes = np.vstack([GREY, np.full((chroma_rows, WIDTH), 77, np.uint8)])
    np.testing.assert_array_equal(decode(message(encoding, planes, height=HEIGHT)), GREY)


def mosaic(pattern, dtype=np.uint8):
    """Make a bayer picture of one colour; the pattern names the first two rows, as in ROS."""
    value = {'r': RED, 'g': GREEN, 'b': BLUE}
    cell = np.array([[value[pattern[0]], value[pattern[1]]],
                     [value[pattern[2]], value[pattern[3]]]], dtype)
    return np.tile(cell, (HEIGHT // 2, WIDTH // 2))


@pytest.mark.parametrize('pattern', ['rggb', 'bggr', 'gbrg', 'grbg'])
def test_bayer_patterns_are_named_as_ros_does(pattern):
    image = decode(message(f'bayer_{pattern}8', mosaic(pattern)))
    assert image.shape == (HEIGHT, WIDTH)
    np.testing.assert_array_equal(image, np.full((HEIGHT, WIDTH), LUMA))


@pytest.mark.parametrize('pattern', ['rggb', 'bggr', 'gbrg', 'grbg'])
@pytest.mark.parametrize('big', [False, True])
def test_deep_bayer(pattern, big):
    deep = message(f'bayer_{pattern}16', mosaic(pattern, np.uint16) * 256, big)
    np.testing.assert_array_equal(decode(deep, BitDepth()),
                                  np.full((HEIGHT, WIDTH), LUMA))


@pytest.mark.parametrize('encoding', ['mono16', '16UC1'])
@pytest.mark.parametrize('big', [False, True])
@pytest.mark.parametrize('bits', [10, 12, 14, 16])
def test_sixteen_bits_hold_fewer(encoding, big, bits):
    deep = GREY.astype(np.uint16) << (bits - 8)
    image = decode(message(encoding, deep, big, padding=2), BitDepth())
    np.testing.assert_array_equal(image, GREY)


def test_bit_depth_grows_with_the_evidence_and_never_shrinks():
    depth = BitDepth()
    bright = message('mono16', np.full((2, 2), 4095, np.uint16))
    dark = message('mono16', np.full((2, 2), 160, np.uint16))
    assert decode(dark, depth)[0, 0] == 160
    assert decode(bright, depth)[0, 0] == 255
    assert decode(dark, depth)[0, 0] == 10
    assert depth.bits == 12


def test_the_image_shares_nothing_with_the_message():
    source = message('mono8', GREY)
    image = decode(source)
    source.data[0] = 99
    assert image[0, 0] == GREY[0, 0]
    image[0, 1] = 123
    assert source.data[1] == GREY[0, 1]


@pytest.mark.parametrize('data', [bytes, bytearray, memoryview,
                                  lambda raw: np.frombuffer(raw, np.uint8)])
def test_any_buffer_will_do(data):
    np.testing.assert_array_equal(
        decode(message('mono8', GREY, data=data(GREY.tobytes()))), GREY)


@pytest.mark.parametrize('changes', [
    {'width': 0}, {'height': 0}, {'step': 0}, {'step': WIDTH - 1}, {'height': HEIGHT + 1},
    {'width': WIDTH + 1}, {'data': b''}, {'height': HEIGHT - 1}, {'encoding': 'bgr8'}])
def test_a_size_that_does_not_fit_is_an_error(changes):
    code = 'E-IMAGE-SIZE' if 0 in (changes.get('width'), changes.get('height')) else (
        'E-IMAGE-LAYOUT')
    with refused(InputError, code):
        decode(message(**{'encoding': 'mono8', 'pixels': GREY, **changes}))


@pytest.mark.parametrize('encoding', ['32FC1', 'rgb565', ''])
def test_unknown_encodings_are_an_error_with_a_cure(encoding):
    with refused(InputError, 'E-IMAGE-ENCODING', repr(encoding), 'mono8'):
        decode(message(encoding, GREY))


def compressed(extension, pixels, name, *options):
    data = cv2.imencode(extension, pixels, list(options))[1].tobytes()
    return compressed_message(format=name, data=array.array('B', data))


@pytest.mark.parametrize('name', ['png', 'mono8; png compressed ', ''])
def test_png_is_exact(name):
    image = decode(compressed('.png', GREY, name))
    np.testing.assert_array_equal(image, GREY)


def test_compressed_colour_becomes_grey():
    image = decode(
        compressed('.png', colour(BLUE, GREEN, RED), 'bgr8; png compressed bgr8'))
    assert abs(int(image[0, 0]) - LUMA) <= 1
    assert image.shape == (HEIGHT, WIDTH)


def test_jpeg_is_close():
    image = decode(compressed('.jpg', GREY, 'jpeg', cv2.IMWRITE_JPEG_QUALITY, 100))
    assert np.abs(image.astype(int) - GREY).max() <= 3


def test_deep_png_keeps_its_lower_bits():
    deep = compressed('.png', GREY.astype(np.uint16) << 4, 'mono16; png compressed')
    np.testing.assert_array_equal(decode(deep, BitDepth()), GREY)


@pytest.mark.parametrize(('name', 'code'), [
    ('16UC1; compressedDepth', 'E-IMAGE-DEPTH'), ('32FC1; compressedDepth png', 'E-IMAGE-DEPTH'),
    ('h264', 'E-IMAGE-VIDEO')])
def test_formats_that_are_no_pictures(name, code):
    with refused(InputError, code, name):
        decode(compressed('.png', GREY, name))


@pytest.mark.parametrize('data', [b'', b'junk', bytes(1000)])
def test_junk_is_an_error(data):
    with refused(InputError, 'E-IMAGE-DAMAGED', f'({len(data)} bytes)'):
        decode(compressed_message(format='jpeg', data=data))


@pytest.mark.parametrize(('extension', 'code'), [
    ('.jpg', 'E-IMAGE-TRUNCATED'), *((each, 'E-IMAGE-DAMAGED') for each in (
        '.png', '.bmp', '.tif', '.webp', '.pgm'))])
def test_a_cut_picture_is_never_half_shown(extension, code):
    noise = np.random.default_rng(1).integers(0, 256, (60, 80), np.uint8)
    data = cv2.imencode(extension, noise)[1].tobytes()
    assert decode_file(data).shape == noise.shape
    with refused(InputError, code):
        decode_file(data[:int(0.7 * len(data))])


@pytest.mark.parametrize(('width', 'height'), [(3, 2), (2, 3)])
def test_planes_of_an_odd_size_have_no_colours(width, height):
    planes = message('nv12', np.zeros((height * 3 // 2, width), np.uint8), height=height)
    assert decode(planes).shape == (height, width)
    with refused(InputError, 'E-IMAGE-CONVERSION', f'{width}x{height * 3 // 2}'):
        decode(planes, colour=True)


def test_float_pictures_are_refused():
    data = cv2.imencode('.tif', np.ones((4, 4), np.float32))[1].tobytes()
    with refused(InputError, 'E-IMAGE-PIXELS', 'depth.tif', 'float32'):
        decode_file(data, what='depth.tif')


# for people to look at

@pytest.mark.parametrize('encoding', ['mono8', 'mono16', 'nv24'])
def test_what_has_no_colours_stays_grey(encoding):
    pixels = np.full((HEIGHT, WIDTH), 4000 if encoding == 'mono16' else 40)
    dtype = np.uint16 if encoding == 'mono16' else np.uint8
    assert decode(message(encoding, pixels.astype(dtype)), colour=True).ndim == 2


@pytest.mark.parametrize('encoding, channels', [
    ('bgr8', (BLUE, GREEN, RED)), ('rgb8', (RED, GREEN, BLUE)), ('bgra8', (BLUE, GREEN, RED, 9)),
    ('rgba8', (RED, GREEN, BLUE, 9))])
def test_colours_are_kept_in_opencv_s_order(encoding, channels):
    image = decode(message(encoding, colour(*channels), padding=3), colour=True)
    np.testing.assert_array_equal(image[..., :3], colour(BLUE, GREEN, RED))
    assert image.shape[2] == 3


def test_colours_of_16_bits_planes_and_mosaics_are_found():
    deep = decode(message('rgb16', colour(4000, 2000, 1000, dtype=np.uint16)), colour=True)
    np.testing.assert_array_equal(deep[0, 0], [62, 125, 250])
    shown = colour(BLUE, GREEN, RED)
    yuv = cv2.cvtColor(shown, cv2.COLOR_BGR2YUV_I420)
    planes = message('i420', yuv, height=HEIGHT)
    assert np.abs(decode(planes, colour=True).astype(int) - shown).max() < 4
    two = np.stack([np.tile(yuv[HEIGHT:].reshape(2, -1)[:, :1].T.repeat(HEIGHT, 0), WIDTH // 2),
                    yuv[:HEIGHT]], -1)
    assert np.abs(decode(message('uyvy', two), colour=True).astype(int) - shown).max() < 4
    mosaic = np.zeros((HEIGHT, WIDTH), np.uint8)
    mosaic[::2, ::2], mosaic[1::2, 1::2] = RED, BLUE
    mosaic[::2, 1::2] = mosaic[1::2, ::2] = GREEN
    found = decode(message('bayer_rggb8', mosaic), colour=True)
    np.testing.assert_array_equal(found[HEIGHT // 2, WIDTH // 2], [BLUE, GREEN, RED])


@pytest.mark.parametrize('kind', ['.png', '.jpg'])
def test_files_are_read_in_colour_where_they_have_it(kind):
    for image in (GREY // 9, colour(BLUE, GREEN, RED)):
        found = decode_file(cv2.imencode(kind, image)[1].tobytes(), colour=True)
        assert np.abs(found.astype(int) - image).max() < 4


@pytest.mark.parametrize('kind', SLOW)
def test_what_takes_long_is_refused_before_it_is_decoded(kind, monkeypatch):
    monkeypatch.setattr(cv2, 'imdecode', None)
    code = 'E-IMAGE-DAMAGED' if kind == 'bytes named twice' else 'E-IMAGE-COMPLEX'
    with refused(InputError, code):
        decode_file(SLOW[kind]())


@pytest.mark.parametrize('kind', QUICK)
def test_what_looks_alike_and_is_quick_is_decoded(kind):
    data = QUICK[kind]()
    assert decode_file(data).shape[::-1] == encoded_size(memoryview(data))


def test_a_message_that_takes_long_is_refused():
    with refused(InputError, 'E-IMAGE-COMPLEX', 'jpeg image', '100 scans'):
        decode(compressed_message(
            format='jpeg', data=np.frombuffer(empty_scans(4000), np.uint8)))


def with_orientation(orientation, image):
    """Return a JPEG that says (EXIF) how it is to be turned."""
    jpeg = cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    entry = struct.pack('<HHIHH', 274, 3, 1, orientation, 0)
    exif = b'Exif\0\0II*\0' + struct.pack('<IH', 8, 1) + entry + bytes(4)
    return jpeg[:2] + b'\xff\xe1' + struct.pack('>H', len(exif) + 2) + exif + jpeg[2:]


def ramps():
    return np.add.outer(np.arange(40) * 4, np.arange(60) * 1).astype(np.uint8)


@pytest.mark.parametrize(('orientation', 'text'), [
    (1, ''), (6, 'rotated by 90 degrees'), (3, 'rotated by 180 degrees'),
    (8, 'rotated by 270 degrees'), (2, 'mirrored')])
def test_what_a_jpeg_says_of_its_orientation_is_told(orientation, text):
    data = with_orientation(orientation, ramps())
    assert turned_text(data, '') == text
    assert (decode_file(data).shape == (60, 40)) == (orientation in (6, 8))
    assert turned_text(data[:300], '') == ''


def test_no_message_is_turned_as_no_program_of_ros_does():
    said = compressed_message(format='jpeg', data=with_orientation(6, ramps()))
    assert decode(said).shape == (40, 60) and message_size(said) == (60, 40)
    assert np.abs(decode(said).astype(int) - ramps()).max() < 5


def test_a_folder_tells_that_its_pictures_are_turned(tmp_path):
    for n in range(3):
        (tmp_path / f'{n}.jpg').write_bytes(with_orientation(6, ramps()))
    source = open_frames(tmp_path, fps=10)
    assert next(iter(source)).size == (40, 60)
    [warning] = source.warnings
    assert warning.code == 'E-IMAGES-ROTATED'
    assert str(tmp_path) in str(warning) and 'rotated by 90 degrees' in str(warning)


def thermal(low, high, seed=0, **changes):
    """Return a 16-bit image whose values are temperatures, with a dead pixel."""
    noise = np.random.default_rng(seed).integers(0, 3, (40, 60))
    values = np.linspace(low, high, 60)[None] + noise
    pixels = values.astype(np.uint16)
    pixels[3, 5] = 0
    return message('16UC1', pixels, **changes)


@pytest.mark.parametrize('big', [False, True])
@pytest.mark.parametrize('low, high', [(7400, 7527), (29000, 31000), (7000, 9000)])
def test_temperatures_are_stretched(low, high, big):
    image = decode(thermal(low, high, big=big), BitDepth())
    assert np.ptp(np.percentile(image, (2, 98))) > 90
    columns = image.mean(axis=0)
    assert (np.diff(columns[1:-1]) > 0).all()


def test_the_range_of_temperatures_grows_rarely_and_never_shrinks():
    depth, maps = BitDepth(), set()
    for n in range(200):
        decode(thermal(7400 - n, 7500 + n, n), depth)
        maps.add(depth._window)
    assert len(maps) <= 5
    again = decode(thermal(7400, 7500), depth)
    assert np.ptp(again) < 100 and len({depth._window} | maps) == len(maps)


def test_cameras_whose_values_begin_at_0_are_as_before():
    pixels = np.linspace(100, 4000, 2400).reshape(40, 60).astype(np.uint16)
    np.testing.assert_array_equal(decode(message('mono16', pixels), BitDepth()), pixels >> 4)


def as_zstd(pack, encoding='bgr8', step=12, data=bytes(range(24))):
    """Return what zstd_image_transport makes of an image of 4x2 pixels."""
    return SimpleNamespace(format='zstd', data=struct.pack(
        '<IIBII', 2, 4, 0, step, len(encoding)) + encoding.encode() + pack(data))


@pytest.mark.parametrize('pack', [gzip.compress, zlib.compress, zstandard.compress])
def test_a_raw_image_that_is_packed(pack):
    given = as_zstd(pack)
    assert message_size(given) == (4, 2)
    plain = SimpleNamespace(encoding='bgr8', height=2, width=4, step=12, is_bigendian=0,
                            data=bytes(range(24)))
    for colour in (False, True):
        np.testing.assert_array_equal(decode(given, colour=colour),
                                      decode(plain, colour=colour))


@pytest.mark.parametrize(('given', 'code'), [
    (as_zstd(lambda data: gzip.compress(data)[:-12]), 'E-IMAGE-LAYOUT'),
    (as_zstd(lambda data: b'junk' + data), 'E-IMAGE-DAMAGED'),
    (as_zstd(gzip.compress, data=bytes(2**24)), 'E-IMAGE-LAYOUT'),
    (as_zstd(gzip.compress, step=2**31), 'E-IMAGE-LAYOUT'),
    (as_zstd(gzip.compress, encoding='32FC1'), 'E-IMAGE-ENCODING'),
    (SimpleNamespace(format='zstd', data=b'short'), 'E-IMAGE-DAMAGED')])
def test_a_packed_image_that_is_none(given, code):
    with refused(InputError, code):
        decode(given)
