# SPDX-License-Identifier: Apache-2.0
"""Tasks for workers of other processes."""
from __future__ import annotations

import os
from pathlib import Path

from dashcalib_ros.errors import InputError


def double(number: int) -> int:
    return 2 * number


def fail(text: str) -> None:
    raise InputError('E-TRIED', text)


def break_down() -> None:
    raise ZeroDivisionError('of a kind that nobody expects')


def die_until(path: str, times: int) -> int:
    """End this process at the first calls; count them in a file."""
    file = Path(path)
    count = int(file.read_text()) if file.exists() else 0
    file.write_text(str(count + 1))
    if count < times:
        os._exit(1)
    return count + 1
