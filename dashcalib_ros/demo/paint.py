# SPDX-License-Identifier: Apache-2.0
"""Textures: façades, cars, leaves, sky. All (h, w) uint8, different for every seed."""
from __future__ import annotations

import string

import cv2
import numpy as np

from dashcalib_ros.arrays import Floats32, GreyImage

Texture = GreyImage
Singles = Floats32
Random = np.random.Generator

FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_COMPLEX,
         cv2.FONT_HERSHEY_TRIPLEX)


def noise(rng: Random, shape: tuple[int, int], cells: tuple[float, ...],
          gains: tuple[float, ...]) -> Singles:
    """Return the sum of smooth noises (h, w); cells: texels of a blob, gains: their sigmas."""
    high, wide = shape
    total = np.zeros(shape, np.float32)
    for cell, gain in zip(cells, gains, strict=True):
        grid = (max(2, round(high / cell)), max(2, round(wide / cell)))
        coarse = rng.standard_normal(grid, np.float32) * np.float32(gain)
        method = cv2.INTER_NEAREST if cell <= 1.0 else cv2.INTER_LINEAR
        total += cv2.resize(coarse, (wide, high), interpolation=method)
    return total


def finish(image: Singles) -> Texture:
    """Return the picture cut to grey levels."""
    return np.clip(image, 4.0, 250.0).astype(np.uint8)


def facade(rng: Random, size_m: tuple[float, float], density: float, light: float, shop: bool,
           grain: Singles) -> Texture:
    """Return a house front.

    size_m: width and height. density: texels per metre. light: relative to full sun. grain: a
    larger picture of fine noise; a piece of it is used.
    """
    width_m, height_m = size_m
    wide, high = max(24, round(width_m * density)), max(24, round(height_m * density))
    image = np.full((high, wide), rng.uniform(85.0, 205.0), np.float32)
    _masonry(rng, image, density)
    floor_m = float(rng.uniform(2.7, 3.4))
    bay_m = float(rng.uniform(1.6, 3.2))
    window = (float(rng.uniform(0.45, 0.7)) * bay_m, float(rng.uniform(0.45, 0.65)) * floor_m)
    frame = float(rng.choice([-50.0, 45.0, 70.0]))
    bays = max(1, int(width_m / bay_m))
    bay_m = width_m / bays
    floors = max(1, int((height_m - 0.5) / floor_m))
    for floor in range(floors):
        bottom = high - floor * floor_m * density
        if floor == 0 and shop:
            _shop_front(rng, image, bottom, floor_m, density)
            continue
        band = round(bottom - floor_m * density)
        if rng.random() < 0.7 and band > 2:
            image[band:band + max(1, round(0.12 * density))] += float(rng.uniform(-35.0, 25.0))
        for bay in range(bays):
            if rng.random() < 0.08:
                continue
            _window(rng, image, (bay + 0.5) * bay_m * density,
                    bottom - 0.52 * floor_m * density, window, frame, density)
    cornice = max(2, round(float(rng.uniform(0.2, 0.5)) * density))
    image[:cornice] += float(rng.uniform(-60.0, 40.0))
    for _ in range(int(rng.integers(0, 3))):
        x = int(rng.uniform(0.0, wide))
        image[:, x:x + max(1, round(0.1 * density))] -= 40.0
    image += noise(rng, (high, wide), (60.0,), (8.0,))
    y, x = (int(rng.integers(0, side)) for side in np.subtract(grain.shape, (high, wide)))
    image += grain[y:y + high, x:x + wide]
    return finish(image * np.float32(light))


def _masonry(rng: Random, image: Singles, density: float) -> None:
    """Lay bricks or panels, each of its own tone, or leave plaster with stains."""
    high, wide = image.shape
    style = int(rng.integers(0, 4))
    if style <= 1:
        brick = (0.28, 0.5) if style == 0 else (float(rng.uniform(0.5, 1.0)), 1.3)
        rows, columns = max(2, round(high / density / brick[0])), \
            max(2, round(wide / density / brick[1]))
        tones = rng.normal(0.0, 9.0, (rows, columns)).astype(np.float32)
        image += cv2.resize(tones, (wide, high), interpolation=cv2.INTER_NEAREST)
        for row in range(rows):
            y = row * high // rows
            image[y:y + max(1, round(0.02 * density))] -= 22.0
    elif style == 2:
        image += noise(rng, (high, wide), (60.0, 12.0), (12.0, 9.0))
    else:
        step = max(4, round(float(rng.uniform(0.15, 0.4)) * density))
        image[:, ::step] -= 25.0


def _window(rng: Random, image: Singles, x: float, y: float, size: tuple[float, float],
            frame: float, density: float) -> None:
    """Paint one window, centred at (x, y) texels; size in metres."""
    half_w, half_h = 0.5 * size[0] * density, 0.5 * size[1] * density
    left, right, top, bottom = (round(x - half_w), round(x + half_w), round(y - half_h),
                                round(y + half_h))
    left, top = max(left, 0), max(top, 0)
    rim = max(1, round(0.07 * density))
    image[max(top - rim, 0):bottom + rim, max(left - rim, 0):right + rim] += frame
    glass = image[top:bottom, left:right]
    if not glass.size:
        return
    shade = float(rng.uniform(25.0, 80.0))
    glass[...] = np.linspace(shade + float(rng.uniform(0.0, 50.0)), shade, glass.shape[0],
                             dtype=np.float32)[:, None]
    kind = rng.random()
    if kind < 0.35:
        blind = round(glass.shape[0] * float(rng.uniform(0.2, 0.9)))
        glass[:blind] = float(rng.uniform(110.0, 200.0))
        glass[:blind:max(2, round(0.08 * density))] -= 25.0
    elif kind < 0.6:
        curtain = max(1, round(glass.shape[1] * float(rng.uniform(0.15, 0.35))))
        tone = float(rng.uniform(120.0, 190.0))
        glass[:, :curtain] = tone
        glass[:, -curtain:] = tone
    bar = max(1, round(0.05 * density))
    middle = glass.shape[1] // 2
    glass[:, middle:middle + bar] = np.clip(image[0, 0] + frame, 30.0, 240.0)
    if rng.random() < 0.5:
        third = glass.shape[0] // 3
        glass[third:third + bar] = np.clip(image[0, 0] + frame, 30.0, 240.0)
    sill = max(1, round(0.08 * density))
    image[bottom + rim:bottom + rim + sill, max(left - 2 * rim, 0):right + 2 * rim] = 60.0


def _shop_front(rng: Random, image: Singles, bottom: float, floor_m: float,
                density: float) -> None:
    """Paint a ground floor with doors, displays and a lettered sign."""
    wide = image.shape[1]
    top = max(0, round(bottom - floor_m * density))
    x = 0
    while x < wide:
        span = round(float(rng.uniform(1.0, 4.0)) * density)
        part = image[round(top + 0.28 * floor_m * density):round(bottom), x:x + span]
        part[...] = float(rng.uniform(25.0, 110.0))
        part[:, :max(1, round(0.12 * density))] = float(rng.uniform(60.0, 220.0))
        if span > 2.0 * density:
            for _ in range(10):
                px, py = int(rng.uniform(0.0, span)), int(rng.uniform(0.0, max(part.shape[0], 1)))
                side = max(2, round(float(rng.uniform(0.1, 0.5)) * density))
                part[py:py + side, px:px + side] = float(rng.uniform(30.0, 230.0))
        x += span
    sign = image[top + round(0.03 * density):round(top + 0.27 * floor_m * density)]
    if sign.shape[0] > 6:
        paper = float(rng.uniform(40.0, 230.0))
        sign[...] = paper
        ink = 235.0 if paper < 130.0 else 25.0
        lettering(rng, sign, ink)


def lettering(rng: Random, image: Singles, ink: float) -> None:
    """Write some words over the whole picture (h, w)."""
    high, wide = image.shape
    scale = high / 36.0
    x = int(rng.uniform(0.0, 0.1) * wide)
    # OpenCV 5 writes on 8 bits only
    cover = np.zeros((high, wide), np.uint8)
    while x < wide - high:
        word = ''.join(rng.choice(list(string.ascii_uppercase), int(rng.integers(3, 9))))
        font = FONTS[int(rng.integers(0, len(FONTS)))]
        cv2.putText(cover, word, (x, round(0.75 * high)), font, scale, 255,
                    max(1, round(scale * 2.0)), cv2.LINE_AA)
        x += round((len(word) + 1.5) * 19.0 * scale)
    image += (np.float32(ink) - image) * (cover / np.float32(255.0))


def car_textures(rng: Random, density: float = 60.0) -> list[Texture]:
    """Return front, side, back and top of a car's body, then of its cabin: eight pictures."""
    paint = float(rng.choice([30.0, 60.0, 110.0, 160.0, 205.0, 225.0]))
    result = []
    for part, (along, across, up) in enumerate(((4.3, 1.75, 0.62), (2.2, 1.5, 0.6))):
        for face, size in enumerate(((across, up), (along, up), (across, up), (across, along))):
            wide, high = round(size[0] * density), round(size[1] * density)
            image = np.full((high, wide), paint, np.float32)
            if part == 0 and face in (0, 2):
                _bumper(rng, image, density)
            elif part == 0 and face == 1:
                _flank(image, density)
            elif part == 1 and face != 3:
                rim = round(0.08 * density)
                image[rim:-rim // 2, rim:-rim] = 45.0
                image[rim:high // 2, rim:-rim] += 35.0
                if face == 1:
                    image[:, wide // 2:wide // 2 + rim] = paint
            image += np.linspace(12.0, -14.0, high, dtype=np.float32)[:, None]
            image += noise(rng, (high, wide), (40.0, 9.0, 1.0), (5.0, 3.0, 2.0))
            result.append(finish(image))
    return result


def _bumper(rng: Random, image: Singles, density: float) -> None:
    high, wide = image.shape
    lamp = round(0.3 * density)
    image[high // 6:high // 2, 3:lamp] = image[high // 6:high // 2, -lamp:-3] = 220.0
    image[high // 5:high // 2, lamp + 4:-lamp - 4] = 40.0
    plate = image[round(0.55 * high):round(0.75 * high), round(0.35 * wide):round(0.65 * wide)]
    plate[...] = 230.0
    lettering(rng, plate, 20.0)
    image[round(0.85 * high):] = 35.0


def _flank(image: Singles, density: float) -> None:
    high, wide = image.shape
    image[round(0.88 * high):] = 30.0
    image[round(0.3 * high):round(0.34 * high)] -= 30.0
    for x in (0.36, 0.58):
        image[:round(0.85 * high), round(x * wide):round(x * wide) + 2] -= 45.0
    for x in (0.2, 0.8):
        center = (round(x * wide), high - round(0.05 * density))
        cv2.circle(image, center, round(0.36 * density), 18.0, -1, cv2.LINE_AA)
        cv2.circle(image, center, round(0.2 * density), 150.0, -1, cv2.LINE_AA)
        cv2.circle(image, center, round(0.07 * density), 40.0, -1, cv2.LINE_AA)


def leaves(rng: Random, light: float) -> Texture:
    """Return 1.6 x 1.6 m of a tree's crown."""
    image = noise(rng, (160, 160), (40.0, 14.0, 6.0, 3.0), (12.0, 18.0, 22.0, 12.0)) + 78.0
    return finish(image * np.float32(light))


def bark(rng: Random) -> Texture:
    """Return a trunk or a post."""
    image = noise(rng, (200, 24), (12.0, 3.0), (14.0, 12.0)) + float(rng.uniform(50.0, 110.0))
    return finish(image)


def sign(rng: Random, wide: int, high: int) -> Texture:
    """Return a road sign or a poster."""
    image = np.full((high, wide), float(rng.uniform(150.0, 235.0)), np.float32)
    image[4:-4, 4:-4] = float(rng.choice([40.0, 90.0, 200.0]))
    ink = 230.0 if image[high // 2, wide // 2] < 130.0 else 25.0
    rows = max(1, high // 40)
    for row in range(rows):
        lettering(rng, image[row * high // rows + 4:(row + 1) * high // rows - 2, 8:-8], ink)
    if rng.random() < 0.5:
        cv2.circle(image, (wide // 2, high // 2), min(wide, high) // 4, ink, 5, cv2.LINE_AA)
    return finish(image + noise(rng, (high, wide), (20.0, 1.0), (4.0, 2.0)))


def skyline(rng: Random, wide: int, high: int) -> Texture:
    """Return far houses and trees."""
    image = np.full((high, wide), 120.0, np.float32)
    for _ in range(wide // 6):
        x, span = int(rng.uniform(0.0, wide)), int(rng.uniform(8.0, 40.0))
        top = int(high * rng.uniform(0.0, 0.6))
        part = image[top:, x:x + span]
        part[...] = float(rng.uniform(60.0, 190.0))
        part[3::6, 2::5] -= 35.0
        part[4::6, 2::5] -= 35.0
    return finish(image + noise(rng, (high, wide), (12.0, 3.0, 1.0), (6.0, 5.0, 4.0)))


def clouds(rng: Random, side: int) -> Texture:
    """Return the sky from below."""
    image = noise(rng, (side, side), (300.0, 120.0, 50.0, 20.0, 9.0),
                  (14.0, 14.0, 11.0, 6.0, 4.0))
    return finish(215.0 + np.clip(image, -25.0, 40.0))


def meadow(rng: Random, side: int) -> Texture:
    """Return the land around the streets."""
    image = noise(rng, (side, side), (40.0, 12.0, 4.0, 1.0), (10.0, 10.0, 8.0, 8.0))
    return finish(image + 105.0)
