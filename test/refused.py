# SPDX-License-Identifier: Apache-2.0
"""How tests check an error: by its class, its code, and the values in its text."""
from __future__ import annotations

from contextlib import contextmanager

import pytest


@contextmanager
def refused(kind, code, *values):
    """Check that an error of this kind and code ends the block, with these texts in one line."""
    with pytest.raises(kind) as caught:
        yield caught
    text = str(caught.value)
    assert (type(caught.value), caught.value.code) == (kind, code), repr(caught.value)
    assert len(text.splitlines()) == 1
    assert all(value in text for value in map(str, values)), text
