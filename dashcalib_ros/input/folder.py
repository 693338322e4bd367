"""A folder of images as a drive."""
from __future__ import annotations

import math
from collections.abc import Generator
from functools import partial
from pathlib import Path

from dashcalib_ros.arrays import Pixels
from dashcalib_ros.errors import InputError
from dashcalib_ros.input.decode import BitDepth, decode_file
from dashcalib_ros.input.source import IMAGE_SUFFIXES, FrameSource, Picture, Reading, by_name
from dashcalib_ros.limits import PICTURE_BYTES, read_file

DEFAULT_FPS = 10.0  # Hz; the rate the paper works at


class FolderSource(FrameSource):
    """The images of a folder, by name; numbers in names count as numbers: 2.png before 10.png.

    Stamps are index / fps. Raises InputError for a folder without images.
    """

    def __init__(self, path: Path, topic: str | None = None, fps: float | None = None) -> None:
        names = [entry.name for entry in path.iterdir()]
        self._path = path
        self._names = sorted(filter(_is_image, names), key=by_name)
        if not self._names:
            raise InputError(_no_images(path, names))
        self._fps = fps or DEFAULT_FPS
        warnings = []
        if fps is None:
            warnings.append(f'{path} is taken as {DEFAULT_FPS:g} images per second: '
                            f'give --fps if it is not')
        if topic is not None:
            warnings.append(f'{path} is a folder of images: topic {topic} is ignored')
        super().__init__(str(path), len(self._names), warnings=tuple(warnings))
        self.length_ns = round(len(self._names) * 1e9 / self._fps)

    def _pictures(self, reading: Reading, start_ns: int = 0) -> Generator[Picture, None, None]:
        depth = BitDepth()
        reading.images = len(self._names)
        for index in range(math.ceil(start_ns * self._fps / 1e9), len(self._names)):
            yield Picture(index, round(index * 1e9 / self._fps),
                          partial(self._image, self._names[index], depth))

    def _image(self, name: str, depth: BitDepth, colour: bool = False) -> Pixels:
        return decode_file(read_file(self._path / name, PICTURE_BYTES, name), depth, name, colour)


def _is_image(name: str) -> bool:
    return Path(name).suffix.lower() in IMAGE_SUFFIXES and not name.startswith('.')


def _no_images(path: Path, names: list[str]) -> str:
    if not names:
        return f'{path} is empty: give a folder of images, a bag or a video'
    return (f'{path} has no images (png, jpg, bmp, tif, pgm, ppm, webp) and is no bag: '
            f'it has {", ".join(sorted(names)[:3])}{" ..." if len(names) > 3 else ""}; '
            f'give the folder or the file that has them')
