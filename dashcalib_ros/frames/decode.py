"""Image messages and image files -> grey images of 8 bits.

Works on anything with the fields of sensor_msgs/Image or sensor_msgs/CompressedImage: messages of
rclpy and of rosbags alike. Needs neither ROS nor cv_bridge.
"""
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

import dashcalib_ros.frames.quiet  # noqa: F401
from dashcalib_ros.arrays import GreyImage, Pixels
from dashcalib_ros.errors import InputError
from dashcalib_ros.frames.header import encoded_size
from dashcalib_ros.limits import check_pixels

_DEPTHS = (8, 10, 12, 14, 16)
_JPEG_START, _JPEG_END = b'\xff\xd8', b'\xff\xd9'
_VIDEO_FORMATS = ('h264', 'h265', 'hevc', 'av1', 'vp9', 'theora')


class BitDepth:
    """How many bits of a stream's 16-bit images are used: one object per stream.

    Cameras of 10, 12 or 14 bits fill only the lower bits of a 16-bit image, and nothing in the
    message says so. The depth is the smallest of 8, 10, 12, 14, 16 that holds every value seen so
    far. It never shrinks: the brightness changes at most four times in a drive, each time because
    a pixel did not fit the old depth.
    """

    def __init__(self) -> None:
        self.bits = _DEPTHS[0]

    def to_8_bits(self, pixels: npt.NDArray[np.uint16]) -> GreyImage:
        """Return the upper 8 bits in use, same shape."""
        needed = int(pixels.max()).bit_length()
        self.bits = max(self.bits, next(depth for depth in _DEPTHS if depth >= needed))
        return (pixels >> (self.bits - 8)).astype(np.uint8)


@dataclass(frozen=True)
class _Layout:
    """How an encoding stores a pixel.

    channels, bits: of one pixel in a row of the message.
    to_grey: OpenCV's conversion; without one, channel number `luma` is the grey value.
    planar: all pixels' brightness comes first, then their colours.
    """

    channels: int
    bits: int = 8
    to_grey: int | None = None
    luma: int = 0
    planar: bool = False


_LAYOUTS = {
    'mono8': _Layout(1), '8uc1': _Layout(1),
    'mono16': _Layout(1, 16), '16uc1': _Layout(1, 16),
    'bgr8': _Layout(3, 8, cv2.COLOR_BGR2GRAY), '8uc3': _Layout(3, 8, cv2.COLOR_BGR2GRAY),
    'rgb8': _Layout(3, 8, cv2.COLOR_RGB2GRAY),
    'bgra8': _Layout(4, 8, cv2.COLOR_BGRA2GRAY), '8uc4': _Layout(4, 8, cv2.COLOR_BGRA2GRAY),
    'rgba8': _Layout(4, 8, cv2.COLOR_RGBA2GRAY),
    'bgr16': _Layout(3, 16, cv2.COLOR_BGR2GRAY), '16uc3': _Layout(3, 16, cv2.COLOR_BGR2GRAY),
    'rgb16': _Layout(3, 16, cv2.COLOR_RGB2GRAY),
    'bgra16': _Layout(4, 16, cv2.COLOR_BGRA2GRAY), '16uc4': _Layout(4, 16, cv2.COLOR_BGRA2GRAY),
    'rgba16': _Layout(4, 16, cv2.COLOR_RGBA2GRAY),
    # ROS: yuv422 is U Y V Y, yuv422_yuy2 is Y U Y V; every second byte is a pixel's brightness
    'yuv422': _Layout(2, luma=1), 'uyvy': _Layout(2, luma=1),
    'yuv422_yuy2': _Layout(2), 'yuyv': _Layout(2), 'yuy2': _Layout(2),
    'nv12': _Layout(1, planar=True), 'nv21': _Layout(1, planar=True),
    'nv24': _Layout(1, planar=True), 'i420': _Layout(1, planar=True),
    # ROS and these constants of OpenCV name the colours of the first two rows, from the corner on
    # (OpenCV's older names, BayerBG for rggb, start one pixel further down the diagonal)
    **{f'bayer_{name}{bits}': _Layout(1, bits, code)
       for bits in (8, 16)
       for name, code in (('rggb', cv2.COLOR_BayerRGGB2GRAY), ('bggr', cv2.COLOR_BayerBGGR2GRAY),
                          ('gbrg', cv2.COLOR_BayerGBRG2GRAY), ('grbg', cv2.COLOR_BayerGRBG2GRAY))},
}


def decode(message: Any, depth: BitDepth | None = None) -> GreyImage:
    """Decode an Image or a CompressedImage message, whichever it is; see the two below."""
    if hasattr(message, 'encoding'):
        return decode_image(message, depth)
    return decode_compressed(message, depth)


def decode_image(message: Any, depth: BitDepth | None = None) -> GreyImage:
    """Decode a sensor_msgs/Image: (height, width) uint8, a copy.

    message: has encoding, height, width, step, is_bigendian and data.
    depth: the stream's bit depth, for 16-bit encodings; without it, only this image counts.

    Raises InputError for an unknown encoding, or a size that does not fit the data.
    """
    layout = _LAYOUTS.get(str(message.encoding).lower())
    if layout is None:
        raise InputError(f'encoding {message.encoding!r} is not supported: '
                         f'publish mono8, bgr8, rgb8, yuv422 or a bayer encoding')
    pixels = _pixels(message, layout)
    if layout.to_grey is None:
        grey = np.array(pixels[..., layout.luma], order='C')
    else:
        grey = _convert(pixels, layout.to_grey)
    return _to_8_bits(grey, depth)


def decode_compressed(message: Any, depth: BitDepth | None = None) -> GreyImage:
    """Decode a sensor_msgs/CompressedImage: (height, width) uint8.

    message: has format and data: a JPEG, PNG, TIFF, WebP, BMP, PGM or PPM.
    depth: as for decode_image.

    Raises InputError for depth images, video streams, data that is cut off or damaged, and for
    more pixels than limits allow.
    """
    return decode_file(memoryview(message.data), depth, _name(message))


def message_size(message: Any) -> tuple[int, int]:
    """Return (width, height) of an Image or CompressedImage message, without decoding it.

    Raises InputError where there is no size in it, or one beyond the limits.
    """
    if hasattr(message, 'encoding'):
        width, height = int(message.width), int(message.height)
        check_pixels(width, height)
        return width, height
    return _encoded_size(memoryview(message.data), _name(message))


def _name(message: Any) -> str:
    """Return a name for messages about a CompressedImage; raises InputError for other formats."""
    name = ' '.join(str(message.format).split())
    if 'compresseddepth' in name.lower():
        raise InputError(f'format {name!r} is a depth image: choose the topic of a camera image')
    if any(video in name.lower() for video in _VIDEO_FORMATS):
        raise InputError(f'format {name!r} is a video stream: republish it as jpeg '
                         f'(image_transport republish)')
    return f'{name or "compressed"} image'


def decode_file(data: bytes | memoryview, depth: BitDepth | None = None,
                what: str = 'image') -> GreyImage:
    """Decode the bytes of an image file: (height, width) uint8; an EXIF orientation is applied.

    Raises InputError as decode_pixels does.
    """
    return _to_8_bits(decode_pixels(data, what), depth)


def decode_pixels(data: bytes | memoryview, what: str = 'image') -> Pixels:
    """Decode the bytes of an image file: (height, width) of 8 or 16 bits.

    what: the image's name in errors. Raises InputError when the bytes are cut off or no image, or
    have more pixels than limits allow.
    """
    _encoded_size(memoryview(data), what)  # check the size before memory is used
    buffer = np.frombuffer(data, np.uint8)
    head, tail = buffer[:2].tobytes(), buffer[-4096:].tobytes()
    if head == _JPEG_START and _JPEG_END not in tail:
        # OpenCV would fill the rest with grey
        raise InputError(f'{what} is cut off: record or copy it again')
    try:
        image = cv2.imdecode(buffer, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    except cv2.error:
        image = None
    if image is None:
        raise _damaged(what, buffer.size)
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(f'{what} has {image.dtype} pixels: save it with 8 or 16 bits')
    return np.asarray(image)


def _encoded_size(data: memoryview, what: str) -> tuple[int, int]:
    size = encoded_size(data)
    if size is None:
        raise _damaged(what, len(data))
    check_pixels(*size, what)
    return size


def _damaged(what: str, size: int) -> InputError:
    return InputError(f'{what} is damaged or of an unknown kind ({size} bytes): record it again, '
                      f'as jpeg or png')


def _pixels(message: Any, layout: _Layout) -> Pixels:
    """Return (height, width, channels), a view of the message where its bytes allow."""
    width, height, step = int(message.width), int(message.height), int(message.step)
    data = np.frombuffer(message.data, np.uint8)
    check_pixels(width, height)
    row = width * layout.channels * layout.bits // 8
    fits = data.size >= step * height if layout.planar else data.size == step * height
    if step < row or not fits:
        raise InputError(
            f'an image says {width}x{height} {message.encoding} with step {step} but has '
            f'{data.size} bytes: the camera driver or the recording is broken')
    rows = data[:step * height].reshape(height, step)[:, :row]
    if layout.bits == 16:
        kind = '>u2' if message.is_bigendian else '<u2'
        rows = np.ascontiguousarray(rows).view(kind).astype(np.uint16)
    return rows.reshape(height, width, layout.channels)


def _convert(pixels: Pixels, code: int) -> Pixels:
    plain = pixels[..., 0] if pixels.shape[2] == 1 else pixels
    try:
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(plain), code))
    except cv2.error as error:
        raise InputError(f'an image of {plain.shape[1]}x{plain.shape[0]} cannot be turned grey: '
                         f'publish mono8 or bgr8 ({error.err})') from error


def _to_8_bits(grey: Pixels, depth: BitDepth | None) -> GreyImage:
    if grey.dtype == np.uint16:
        return (depth or BitDepth()).to_8_bits(grey)
    return grey
