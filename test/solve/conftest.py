# SPDX-License-Identifier: Apache-2.0
"""What the tests of the solution share."""
from __future__ import annotations

import pytest

from dashcalib_ros.solve import start


@pytest.fixture
def no_profile(monkeypatch):
    """Leave out the focal profile around the result, which takes much of the time."""
    monkeypatch.setattr(start, 'PROBES', (1.0,))
