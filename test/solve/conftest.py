"""What the tests of the solution share."""
from __future__ import annotations

import pytest

from dashcalib_ros.solve import focal


@pytest.fixture
def no_profile(monkeypatch):
    """Leave out the focal profile around the result, which takes much of the time."""
    monkeypatch.setattr(focal, 'PROBES', (1.0,))
