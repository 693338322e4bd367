"""Types of arguments: from a text to a value, or an error that says what it should be like."""
from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path


def size(text: str) -> tuple[int, int]:
    """Return a size that is given as WxH."""
    width, height = _whole_numbers(text, 'x', 2, '1280x720')
    return width, height


def crop(text: str) -> list[int]:
    """Return a part of the picture that is given as X,Y,W,H."""
    return _whole_numbers(text, ',', 4, '0,100,1280,520')


def _whole_numbers(text: str, between: str, count: int, like: str) -> list[int]:
    parts = text.lower().split(between)
    if len(parts) != count or not all(part.strip().isdecimal() for part in parts):
        raise argparse.ArgumentTypeError(f'{text!r} is not like {like}')
    return [int(part) for part in parts]


def path_or(cure: str) -> Callable[[str], Path]:
    """Return a type of argument: a path that is not - (standard output elsewhere)."""
    def path(text: str) -> Path:
        if text == '-':
            raise argparse.ArgumentTypeError(f'it cannot be -: {cure}')
        return Path(text)
    return path


def positive(text: str) -> float:
    """Return a number above 0."""
    value = _number(text)
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f'must be a positive number, not {text!r}')
    return value


def seconds(text: str) -> float:
    """Return a number of seconds."""
    value = _number(text)
    if not (math.isfinite(value) and value >= 0):
        raise argparse.ArgumentTypeError(f'must be 0 or more seconds, not {text!r}')
    return value


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
