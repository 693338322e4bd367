# SPDX-License-Identifier: Apache-2.0
"""The kinds of arrays that the rooms exchange, and values as plain types."""
from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from dashcalib_ros.errors import Notice

Floats = npt.NDArray[np.float64]
Floats32 = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int64]
#: (h, w) or along an array: True where something holds
Mask = npt.NDArray[np.bool_]
#: (h, w) uint8
GreyImage = npt.NDArray[np.uint8]
#: of any type, as an input stores them
Pixels = npt.NDArray[Any]


def plain_values(value: Any) -> Any:
    """Return the value as types of strict JSON; NaN and infinity become None."""
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, (str, Notice)):
        return str(value)
    if isinstance(value, (np.ndarray, np.generic)):
        return plain_values(value.tolist())
    if isinstance(value, int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return plain_values({f.name: getattr(value, f.name) for f in dataclasses.fields(value)})
    if isinstance(value, Mapping):
        return {str(key): plain_values(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_values(item) for item in value]
    return str(value)
