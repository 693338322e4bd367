"""The kinds of arrays that the rooms exchange."""
from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Floats32 = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int64]
#: (h, w) or along an array: True where something holds
Mask = npt.NDArray[np.bool_]
#: (h, w) uint8
GreyImage = npt.NDArray[np.uint8]
#: of any type, as an input stores them
Pixels = npt.NDArray[Any]
