#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Videos that no fixed camera takes, and other bad ones: none may be accepted and wrong.

    python benchmark/attacks.py [ATTACK ...] [--drives NAME ...] [--seeds 0 1 2] [--data DIR]
                                [--cache DIR] [--out DIR] [--results] [--again] [--list]
                                [--summary]

Each attack changes the pictures or the stamps of a drive of which the camera is known. A row goes
to DIR/attacks.json after each, and one that is there is not run again; DIR/attacks.md counts them:
verdicts, how often the trouble was named, and the worst error of those accepted.
"""
from __future__ import annotations

import io
import json
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import numpy.typing as npt
from drives import BY_NAME, drive_of, pictures_of
from mapping import camera_that_sees, rays
from measure import (
    calibrate,
    commit,
    done,
    isolated,
    keep_table,
    load,
    mapping_cell,
    parser_with,
    save,
    summarised,
    table,
)
from scipy.ndimage import gaussian_filter1d
from views import INEXACT, inexact_view
from wide import WIDE, wide_drive_of

from dashcalib_ros import Config, open_frames
from dashcalib_ros.input import Frame

Floats = npt.NDArray[np.float64]
Grey = npt.NDArray[np.uint8]

# the words by which a result names the trouble; any of them will do
STABILISED = ('stabil',)
ZOOMED = ('zoom', 'focus', 'camera far better', 'disagree')
SHIFTED = (*STABILISED, *ZOOMED, 'moves')
BENT = ('bent', 'windscreen', 'lens seems')
REPEATED = ('repeat', 'same place', 'turns could be used')
RENDERED = ('dashcam: bonnet, text', 'KITTI raw lens, 1392x512', '640x480, fy/fx 1.01, noise 3',
            '48 deg, pincushion')
RECORDED = {'kitti03': ('bag', None), 'kitti07': ('images', 9.65), 'ntu_campus': ('images', 3.0)}
# the frames in the middle of the turns
TURNS = {'kitti03': (88,), 'kitti07': (25, 137)}
# what is known about the truth, where that is not all. KITTI's K lacks a k1 of 0.02: fx is what
# pictures and true rotation together say
KNOWN = {'kitti03': ('fx',), 'kitti07': ('fx',), 'ntu_campus': ('fx', 'fy')}
TRUE_FX = {'kitti03': 718.2, 'kitti07': 701.9}
FILMS = (*RECORDED, *RENDERED, 'fisheye 150 deg, bonnet, text', 'p1, p2 0.003')
MOST_FX_PERCENT = 3.0
MOST_SIGMAS = 5.0


@dataclass(frozen=True)
class Film:
    """A drive to attack. yaw, pitch: of each frame, rad, the camera turning right and down.

    turns: the frames in the middle of its turns.
    """

    frames: Sequence[Frame]
    truth: Mapping[str, Any]
    yaw: Floats
    pitch: Floats
    turns: tuple[int, ...]

    @property
    def seconds(self) -> Floats:
        """Return the frames' times since the first."""
        stamps = np.array([frame.stamp_ns for frame in self.frames], np.int64)
        return np.asarray((stamps - stamps[0]) / 1e9)


@dataclass(frozen=True)
class Attack:
    """What becomes of a film. words: of a result that names it; empty: it should do no harm."""

    name: str
    change: Callable[[Film, np.random.Generator], Film]
    words: tuple[str, ...] = ()


def with_pictures(film: Film, pictures: Iterable[Grey], **truth: Any) -> Film:
    """Return the film with other pictures, and some of its truth changed."""
    frames = [replace(frame, image=np.ascontiguousarray(picture))
              for frame, picture in zip(film.frames, pictures, strict=True)]
    height, width = frames[0].image.shape
    return replace(film, frames=frames,
                   truth={**film.truth, 'width': width, 'height': height, **truth})


def warped(image: Grey, matrix: Floats, size: tuple[int, int] | None = None) -> Grey:
    """Return the picture resampled: matrix (2, 3) takes pixels of the result to its own."""
    return np.asarray(cv2.warpAffine(
        image, matrix, size or image.shape[::-1], flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE), np.uint8)


def swings(angle: Floats, seconds: Floats, lag_s: float, gaussian: bool = False) -> Floats:
    """Return what a stabiliser takes out of angles (n,).

    lag_s: of the low pass, or sigma of a Gaussian that knows the future.
    """
    if gaussian:
        return np.asarray(angle - gaussian_filter1d(
            angle, lag_s / np.median(np.diff(seconds)), mode='nearest'))
    smooth = np.empty_like(angle)
    smooth[0] = angle[0]
    for k in range(1, len(angle)):
        keep = np.exp(-(seconds[k] - seconds[k - 1]) / lag_s)
        smooth[k] = keep * smooth[k - 1] + (1 - keep) * angle[k]
    return angle - smooth


def stabilised(limit: float, lag_s: float, pitched: bool = False, gaussian: bool = False
               ) -> Callable[[Film, np.random.Generator], Film]:
    """Move the crop against the car's turning, up to limit times the width; see swings()."""
    def lagging(angle: Floats, seconds: Floats) -> Floats:
        return swings(angle, seconds, lag_s, gaussian)

    def change(film: Film, rng: np.random.Generator) -> Film:
        height, width = film.frames[0].image.shape
        most = limit * width
        margin = int(np.ceil(most)) + 2
        # the content of a turning camera moves against the turn, and the crop goes with it
        across = np.clip(-film.truth['fx'] * lagging(film.yaw, film.seconds), -most, most)
        down = np.zeros(len(across))
        if pitched:
            shake = gaussian_filter1d(rng.normal(size=len(across)), 3.0)
            shake *= 0.004 / max(float(shake.std()), 1e-9)
            down = np.clip(-film.truth['fx'] * (shake + lagging(film.pitch, film.seconds)),
                           -most, most)
        above = margin if pitched else 0
        size = width - 2 * margin, height - 2 * above
        moved = (warped(frame.image, np.array([[1.0, 0.0, margin + x], [0.0, 1.0, above + y]]),
                        size) for frame, x, y in zip(film.frames, across, down, strict=True))
        return with_pictures(film, moved, cx=film.truth['cx'] - margin,
                             cy=film.truth['cy'] - above)

    return change


def zoomed(scale_of: Callable[[Floats, int], Floats]
           ) -> Callable[[Film, np.random.Generator], Film]:
    """Enlarge each picture about its middle. scale_of: of times and count of frames."""
    def change(film: Film, rng: np.random.Generator) -> Film:
        height, width = film.frames[0].image.shape
        middle = np.array([(width - 1) / 2, (height - 1) / 2])
        scales = scale_of(film.seconds, len(film.frames))
        return with_pictures(film, (
            warped(frame.image, np.column_stack([np.eye(2) / scale, middle * (1 - 1 / scale)]))
            for frame, scale in zip(film.frames, scales, strict=True)))

    return change


def stepped(scale: float, since: float) -> Callable[[Film, np.random.Generator], Film]:
    """Zoom by a factor after this share of the drive."""
    return zoomed(lambda seconds, count: np.where(np.arange(count) < since * count, 1.0, scale))


def breathing(percent: float) -> Callable[[Film, np.random.Generator], Film]:
    """Zoom in and out again every two seconds."""
    return zoomed(lambda seconds, count:
                  1.0 + percent / 100 * (1 + np.sin(np.pi * seconds)) / 2)


def behind_windscreen(most_px: float) -> Callable[[Film, np.random.Generator], Film]:
    """Bend the picture smoothly and locally: three bumps, a sixth to a third of the width.

    The truth becomes the camera that comes closest to lens and windscreen together.
    """
    def change(film: Film, rng: np.random.Generator) -> Film:
        height, width = film.frames[0].image.shape
        x, y = np.meshgrid(np.arange(width), np.arange(height))
        off = np.zeros((2, height, width))
        for _ in range(3):
            at = rng.uniform(0.1, 0.9, 2) * (width, height)
            reach = rng.uniform(1 / 6, 1 / 3) * width
            angle = rng.uniform(0, 2 * np.pi)
            bump = np.exp(-((x - at[0])**2 + (y - at[1])**2) / (2 * reach**2))
            off += np.array([np.cos(angle), np.sin(angle)])[:, None, None] * bump
        off -= off.mean(axis=(1, 2), keepdims=True)
        off *= most_px / np.hypot(*off).max()
        columns, rows = (x + off[0]).astype(np.float32), (y + off[1]).astype(np.float32)
        pixels = np.stack([x, y], axis=-1)[::8, ::8].reshape(-1, 2).astype(float)
        seen = rays(film.truth, pixels + off[:, ::8, ::8].reshape(2, -1).T)
        return with_pictures(film, (
            np.asarray(cv2.remap(frame.image, columns, rows, cv2.INTER_CUBIC,
                                 borderMode=cv2.BORDER_REPLICATE), np.uint8)
            for frame in film.frames), **camera_that_sees(seen, pixels, film.truth))

    return change


def looped(times: int, there_and_back: bool = False, fresh_noise: float = 0.0,
           reach_s: float = 5.0) -> Callable[[Film, np.random.Generator], Film]:
    """Show the first turn so many times. reach_s: to either side of its middle."""
    def change(film: Film, rng: np.random.Generator) -> Film:
        step = float(np.median(np.diff(film.seconds)))
        reach = round(reach_s / step)
        first = max(film.turns[0] - reach, 0)
        part = list(range(first, min(film.turns[0] + reach, len(film.frames))))
        order = [k for n in range(times)
                 for k in (part[::-1] if there_and_back and n % 2 else part)]
        frames = []
        for n, k in enumerate(order):
            image = film.frames[k].image
            if fresh_noise:
                noisy = image + rng.normal(0.0, fresh_noise, image.shape)
                image = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
            frames.append(Frame(n, film.frames[0].stamp_ns + round(n * step * 1e9), image))
        return replace(film, frames=frames, yaw=film.yaw[order], pitch=film.pitch[order])

    return change


def restamped(stamps_of: Callable[[npt.NDArray[np.int64]], npt.NDArray[np.int64]],
              copies: int = 1) -> Callable[[Film, np.random.Generator], Film]:
    """Give each picture so many times, with other stamps."""
    def change(film: Film, rng: np.random.Generator) -> Film:
        stamps = stamps_of(np.repeat([frame.stamp_ns for frame in film.frames], copies))
        return replace(film, frames=[
            Frame(n, int(stamp), film.frames[n // copies].image)
            for n, stamp in enumerate(stamps)])

    return change


def chosen(order_of: Callable[[int, np.random.Generator], npt.NDArray[np.int64]]
           ) -> Callable[[Film, np.random.Generator], Film]:
    """Take the pictures in another order, or a part of them; the stamps' order stays."""
    def change(film: Film, rng: np.random.Generator) -> Film:
        order = order_of(len(film.frames), rng)
        stamps = sorted(film.frames[k].stamp_ns for k in order)
        return replace(film, frames=[Frame(n, stamp, film.frames[k].image)
                                     for n, (k, stamp) in enumerate(zip(order, stamps,
                                                                        strict=True))])

    return change


def swapped_pairs(count: int, rng: np.random.Generator) -> npt.NDArray[np.int64]:
    """Return an order in which every tenth picture comes after its successor."""
    order = np.arange(count)
    for k in range(5, count - 1, 10):
        order[[k, k + 1]] = order[[k + 1, k]]
    return order


def a_third_lost(count: int, rng: np.random.Generator) -> npt.NDArray[np.int64]:
    """Return two thirds of the pictures."""
    return np.sort(rng.choice(count, 2 * count // 3, replace=False))


def painted(paint: Callable[[Grey, np.random.Generator], npt.NDArray[Any]]
            ) -> Callable[[Film, np.random.Generator], Film]:
    """Change each picture alone."""
    def change(film: Film, rng: np.random.Generator) -> Film:
        return with_pictures(film, (
            np.clip(np.rint(paint(frame.image, rng)), 0, 255).astype(np.uint8)
            for frame in film.frames))

    return change


def rain(image: Grey, rng: np.random.Generator) -> npt.NDArray[Any]:
    """Return the picture with bright streaks."""
    wet = image.astype(np.float64)
    height, width = image.shape
    for x, y in zip(rng.integers(0, width, 150), rng.integers(0, height - 12, 150), strict=True):
        wet[y:y + 12, x] += 60
    return wet


def reflection(image: Grey, rng: np.random.Generator) -> npt.NDArray[Any]:
    """Return the picture with a dashboard mirrored in the lower half of the windscreen."""
    height, width = image.shape
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    pattern = 30 * (np.sin(x / 17.0) > 0.6) * (y > height / 2) * (np.sin(y / 23.0) > 0)
    return np.asarray(0.8 * image + pattern)


def jpeg(quality: int) -> Callable[[Grey, np.random.Generator], npt.NDArray[Any]]:
    """Return the picture compressed."""
    def squeeze(image: Grey, rng: np.random.Generator) -> npt.NDArray[Any]:
        code = cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        return np.asarray(cv2.imdecode(code, cv2.IMREAD_GRAYSCALE))

    return squeeze


def letterbox(image: Grey, rng: np.random.Generator) -> npt.NDArray[Any]:
    """Return the picture with black bars over a tenth at the top and at the bottom."""
    bar = image.shape[0] // 10
    boxed = image.copy()
    boxed[:bar] = boxed[-bar:] = 0
    return boxed


def mirrored(film: Film, rng: np.random.Generator) -> Film:
    """Swap left and right."""
    width = film.frames[0].image.shape[1]
    changed = {'cx': width - 1 - film.truth['cx']}
    if film.truth.get('p2'):
        changed['p2'] = -film.truth['p2']
    return with_pictures(film, (frame.image[:, ::-1] for frame in film.frames), **changed)


def cropped(left: float = 0.0, above: float = 0.0) -> Callable[[Film, np.random.Generator], Film]:
    """Cut a share of the width off on the left, and of the height above."""
    def change(film: Film, rng: np.random.Generator) -> Film:
        height, width = film.frames[0].image.shape
        x, y = round(left * width), round(above * height)
        return with_pictures(film, (frame.image[y:, x:] for frame in film.frames),
                             cx=film.truth['cx'] - x, cy=film.truth['cy'] - y)

    return change


def stretched(factor: float) -> Callable[[Film, np.random.Generator], Film]:
    """Make the picture wider, as one of 4:3 that is stored as 16:9."""
    def change(film: Film, rng: np.random.Generator) -> Film:
        height, width = film.frames[0].image.shape
        size = round(factor * width), height
        exact = size[0] / width
        method = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
        return with_pictures(
            film, (np.asarray(cv2.resize(frame.image, size, interpolation=method), np.uint8)
                   for frame in film.frames),
            fx=film.truth['fx'] * exact, cx=(film.truth['cx'] + 0.5) * exact - 0.5)

    return change


def in_turns(percent: float) -> Callable[[Film, np.random.Generator], Film]:
    """Zoom with the speed of turning, all turns alike."""
    def change(film: Film, rng: np.random.Generator) -> Film:
        rate = np.abs(np.gradient(gaussian_filter1d(film.yaw, 5.0)))
        return zoomed(lambda seconds, count: 1 + percent / 100 * rate / rate.max())(film, rng)

    return change


def shifted(share: float) -> Callable[[Film, np.random.Generator], Film]:
    """Move the picture sideways by a share of its width after half of the drive."""
    def change(film: Film, rng: np.random.Generator) -> Film:
        count, width = len(film.frames), film.frames[0].image.shape[1]
        return with_pictures(film, (
            warped(frame.image, np.array([[1.0, 0.0, share * width * (2 * n > count)],
                                          [0.0, 1.0, 0.0]]))
            for n, frame in enumerate(film.frames)))

    return change


def blended(film: Film, rng: np.random.Generator) -> Film:
    """Mix each picture with the next in a share that goes round, as a changed rate does."""
    images = [frame.image for frame in film.frames]
    mixed = []
    for n, (now, then) in enumerate(zip(images, [*images[1:], images[-1]], strict=True)):
        share = (n % 5) / 5
        mixed.append(np.asarray(cv2.addWeighted(now, 1 - share, then, share, 0), np.uint8))
    return with_pictures(film, mixed)


def frozen(film: Film, rng: np.random.Generator) -> Film:
    """Show every fourth picture in the place of the one after it, too."""
    return with_pictures(film, (film.frames[n - (n % 4 == 3)].image
                                for n in range(len(film.frames))))


def picture_in_picture(film: Film, rng: np.random.Generator) -> Film:
    """Show the drive itself, a quarter as large and later, in a corner."""
    height, width = film.frames[0].image.shape
    size = width // 4, height // 4
    shown = []
    for n, frame in enumerate(film.frames):
        image = frame.image.copy()
        later = film.frames[(n + 40) % len(film.frames)].image
        image[:size[1], :size[0]] = cv2.resize(later, size, interpolation=cv2.INTER_AREA)
        shown.append(image)
    return with_pictures(film, shown)


def compressed(bits_per_pixel: float) -> Callable[[Film, np.random.Generator], Film]:
    """Encode the film as H.264 with few bits, as a cheap dashcam does."""
    def change(film: Film, rng: np.random.Generator) -> Film:
        height, width = (side // 2 * 2 for side in film.frames[0].image.shape)
        rate = round(1 / float(np.median(np.diff(film.seconds))))
        data = io.BytesIO()
        with av.open(data, 'w', format='mp4') as box:
            stream = box.add_stream('libx264', rate=rate)
            stream.width, stream.height, stream.pix_fmt = width, height, 'yuv420p'
            stream.bit_rate = round(bits_per_pixel * width * height * rate)
            for frame in film.frames:
                image = np.ascontiguousarray(frame.image[:height, :width])
                picture = av.VideoFrame.from_ndarray(image, format='gray')
                box.mux(stream.encode(picture))
            box.mux(stream.encode())
        data.seek(0)
        with av.open(data, 'r') as video:
            decoded = [np.asarray(picture.to_ndarray(format='gray'), np.uint8)
                       for picture in video.decode(video=0)]
        return with_pictures(film, decoded)

    return change


ATTACKS = (
    *(Attack(f'stabilised, {100 * limit:.0f} %, lag {lag} s', stabilised(limit, lag), STABILISED)
      for limit in (0.02, 0.05, 0.10) for lag in (0.2, 0.5, 1.0)),
    *(Attack(f'stabilised, {100 * limit:.0f} %, Gaussian {lag} s',
             stabilised(limit, lag, gaussian=True), STABILISED)
      for limit, lag in ((0.04, 0.5), (0.10, 0.3))),
    *(Attack(f'stabilised, {100 * limit:.0f} %, lag {lag} s, pitch',
             stabilised(limit, lag, True), STABILISED)
      for limit, lag in ((0.05, 0.5), (0.10, 1.0))),
    Attack('zoom 5 % after a third', stepped(1.05, 1 / 3), ZOOMED),
    *(Attack(f'zoom {zoom} % after {100 * since:.0f} %', stepped(1 + zoom / 100, since), ZOOMED)
      for zoom in (2, 10) for since in (0.3, 0.5, 0.7)),
    Attack('every other picture zoomed 2 %',
           zoomed(lambda seconds, count: np.where(np.arange(count) % 2, 1.02, 1.0)), ZOOMED),
    Attack('zoom 6 %, slowly',
           zoomed(lambda seconds, count: np.linspace(1.0, 1.06, count)), ZOOMED),
    *(Attack(f'breathing {percent} %', breathing(percent), ZOOMED) for percent in (1, 3)),
    *(Attack(f'windscreen {most} px', behind_windscreen(most), BENT) for most in (1.5, 3.0, 5.0)),
    Attack('one turn five times', looped(5), REPEATED),
    Attack('one turn five times, there and back', looped(5, True), REPEATED),
    *(Attack(f'one turn three times, there and back, {reach} s', looped(3, True, reach_s=reach),
             REPEATED) for reach in (3.5, 2.5)),
    Attack('one turn five times, other noise', looped(5, fresh_noise=3.0), REPEATED),
    Attack('every image twice, same stamps', restamped(lambda stamps: stamps, 2)),
    Attack('every image twice', restamped(
        lambda stamps: np.linspace(stamps[0], stamps[-1], len(stamps)).astype(np.int64), 2)),
    Attack('twice the rate', restamped(lambda stamps: stamps[0] + (stamps - stamps[0]) // 2)),
    Attack('half the rate', restamped(lambda stamps: stamps[0] + (stamps - stamps[0]) * 2)),
    Attack('a third of the images lost', chosen(a_third_lost)),
    Attack('images swapped', chosen(swapped_pairs)),
    Attack('mirrored', mirrored),
    Attack('letterbox', painted(letterbox)),
    Attack('rain', painted(rain)),
    Attack('reflection', painted(reflection)),
    *(Attack(f'{100 * left:.0f} % cut off on the left', cropped(left)) for left in (0.1, 0.25)),
    *(Attack(f'{100 * above:.0f} % cut off above', cropped(above=above)) for above in (0.2, 0.4)),
    *(Attack(f'{factor} times as wide', stretched(factor)) for factor in (0.75, 1.1, 1.33)),
    *(Attack(f'zoom {percent} % in turns', in_turns(percent), ZOOMED) for percent in (2, 5)),
    *(Attack(f'shifted by {100 * share:.0f} % after half', shifted(share), SHIFTED)
      for share in (0.01, 0.03)),
    Attack('pictures blended', blended),
    Attack('every fourth picture frozen', frozen),
    Attack('picture in picture', picture_in_picture),
    *(Attack(f'H.264, {bits} bits per pixel', compressed(bits)) for bits in (0.1, 0.03)),
    Attack('JPEG 10', painted(jpeg(10))),
    Attack('none', lambda film, rng: film),
)
BY_ATTACK = {attack.name: attack for attack in ATTACKS}


def film_of(name: str, seed: int, data: Path | None, cache: Path) -> Film:
    """Return a drive to attack; it is rendered on the way."""
    if name in RECORDED:
        assert data is not None
        return _recorded(name, data)
    if name in WIDE:
        wide = wide_drive_of(name, seed)
        return _film(pictures_of(wide, cache), wide.truth, wide)
    if name in INEXACT:
        viewed = inexact_view(name, seed, cache)
        return _film(viewed, viewed.truth, drive_of(BY_NAME['no distortion'], seed))
    drive = drive_of(BY_NAME[name], seed)
    truth = {**drive.truth, 'width': drive.lens.width, 'height': drive.lens.height}
    return _film(pictures_of(drive, cache), truth, drive)


def _film(frames: Iterable[Frame], truth: Mapping[str, Any], drive: Any) -> Film:
    # a drive's yaw grows to the left
    return Film(list(frames), truth, -drive.yaw, np.zeros(len(drive.yaw)), drive.turn_centers)


def _recorded(name: str, data: Path) -> Film:
    truth = {key: value for key, value in json.loads((data / name / 'truth.json').read_text()
                                                     ).items() if not isinstance(value, list)}
    truth['fx'] = TRUE_FX.get(name, truth['fx'])
    folder, fps = RECORDED[name]
    frames = list(open_frames(data / name / folder, fps=fps))
    if name != 'ntu_campus':
        poses = np.loadtxt(data / name / 'poses.txt')[:, -12:].reshape(-1, 3, 4)
        ahead = poses[:, :, 2]
        yaw = np.unwrap(np.arctan2(ahead[:, 0], ahead[:, 2]))
        pitch = np.arctan2(ahead[:, 1], np.hypot(ahead[:, 0], ahead[:, 2]))
        return Film(frames, truth, yaw, pitch, TURNS[name])
    # by how much the pictures' middles move; the camera's own yaw is not known
    turning = np.zeros(len(frames))
    middles = [frame.image[100:260].astype(np.float32) for frame in frames]
    for k in range(1, len(frames)):
        (moved, _), _ = cv2.phaseCorrelate(middles[k - 1], middles[k])
        turning[k] = -moved / truth['fx']
    turns = (int(np.argmax(np.abs(gaussian_filter1d(turning, 4.0)))),)
    return Film(frames, truth, np.cumsum(turning), np.zeros(len(frames)), turns)


def attacked(attack: str, film: str, seed: int, data: Path | None, cache: Path) -> dict[str, Any]:
    """Calibrate a film under attack (in a process of its own)."""
    rng = np.random.default_rng([seed, sum(map(ord, attack + film))])
    changed = BY_ATTACK[attack].change(film_of(film, seed, data, cache), rng)
    result, seconds = calibrate(iter(changed.frames), Config(seed=seed))
    known = KNOWN.get(film)
    row = (summarised(result, changed.truth) if known is None
           else summarised(result, changed.truth, known))
    said = ' '.join(map(str, (*result.verdict.reasons, *result.warnings))).lower()
    return {**row, 'seconds': seconds,
            'named': any(word in said for word in BY_ATTACK[attack].words)}


def wrong(row: Mapping[str, Any], film: str) -> bool:
    """Return whether a result was accepted and is wrong by the bars.

    So is any for pictures that move, and any from one place alone: nothing confirms it.
    """
    if row['verdict'] != 'accepted':
        return False
    if BY_ATTACK[row['attack']].words in (STABILISED, REPEATED):
        return True
    fx = (row.get('percent') or {}).get('fx') or 0.0
    known = film not in KNOWN
    z = max((abs(value) for value in (row.get('z') or {}).values()), default=0.0)
    far = known and (row.get('mapping_px') or 0.0) > 3 * (row['sigma_px'] or {'rms': 0.0})['rms']
    return bool(fx > MOST_FX_PERCENT or z > MOST_SIGMAS or far)


def summary(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a line for each attack: counts, and the worst of those accepted."""
    lines = []
    for attack in ATTACKS:
        own = {name: row for name, row in rows.items() if row['attack'] == attack.name}
        if not own:
            continue
        accepted = [row for row in own.values() if row['verdict'] == 'accepted']
        lines.append([
            attack.name, str(len(own)),
            *(str(sum(row['verdict'] == verdict for row in own.values()))
              for verdict in ('accepted', 'weak', 'refused', 'failed')),
            str(sum(bool(row.get('named')) for row in own.values())) if attack.words else '',
            _most((row.get('percent') or {}).get('fx') for row in accepted),
            _most(max((abs(z) for z in (row.get('z') or {}).values()), default=0.0)
                  for row in accepted),
            _most((row['mapping_px'] / row['sigma_px']['rms'])
                  for row in accepted
                  if row['film'] not in KNOWN and row.get('sigma_px')),
            str(sum(wrong(row, row['film']) for row in own.values()))])
    return table(['attack', 'drives', 'accepted', 'weak', 'refused', 'failed', 'named',
                  'worst fx % of those accepted', 'worst error, sigmas', 'worst mapping, sigmas',
                  'accepted and wrong'], lines)


def _most(values: Iterable[float | None]) -> str:
    known = [value for value in values if value is not None]
    return f'{max(known):.2f}' if known else ''


def _lines(row: Mapping[str, Any]) -> Iterator[str]:
    z = row.get('z') or {}
    yield (f'{row["attack"]} | {row["film"]} {row["seed"]} | {row["verdict"]} | '
           f'{row.get("model", "")} | fx {(row.get("percent") or {}).get("fx") or 0:.2f} % | '
           f'z {max(map(abs, z.values()), default=0):.1f} | map {mapping_cell(row)} of '
           f'{((row.get("sigma_px") or {}).get("rms") or 0):.2f} | named {row.get("named")} | '
           f'{row.get("seconds", {}).get("total", 0):.0f} s')
    for text in (*row.get('reasons', ()), *row.get('warnings', ())):
        yield f'    {text}'


def main() -> None:
    parser = parser_with(__doc__, 'seeds', 'drives', 'data', 'cache', 'again', drives=FILMS)
    parser.add_argument('attacks', nargs='*', help='parts of names; default: all')
    parser.add_argument('--list', action='store_true', help='name the attacks, and end')
    parser.add_argument('--summary', action='store_true', help='of the rows there are, and end')
    options = parser.parse_args()
    if options.list:
        print('\n'.join(BY_ATTACK))
        return
    path = options.out / 'attacks.json'
    rows = load(path)
    names = [name for name in BY_ATTACK
             if not options.attacks or any(part in name for part in options.attacks)]
    cache = options.cache or Path('measured') / 'pictures'
    cache.mkdir(parents=True, exist_ok=True)
    for seed in () if options.summary else options.seeds:
        for film in options.drives:
            if film in RECORDED and (options.data is None or seed != options.seeds[0]):
                continue
            for name in names:
                key = f'{name} | {film} | {seed}'
                if done(rows.get(key)) and not options.again:
                    continue
                started = time.monotonic()
                outcome = isolated(attacked, name, film, seed, options.data, cache)
                row = outcome.value or {'verdict': 'failed', 'reasons': [outcome.failure]}
                rows[key] = {'attack': name, 'film': film, 'seed': seed, **row,
                             'took_s': round(time.monotonic() - started, 1), 'commit': commit()}
                save(path, rows)
                print('\n'.join(_lines(rows[key])), flush=True)
    keep_table('attacks', summary(rows), options, [row['commit'] for row in rows.values()])


if __name__ == '__main__':
    os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
    main()
