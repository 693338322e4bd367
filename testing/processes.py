# SPDX-License-Identifier: Apache-2.0
"""The processes of a session, as /proc lists them."""
from __future__ import annotations

from pathlib import Path


def processes_of(session: int) -> list[int]:
    """Return the ids of all living processes of a session."""
    found = []
    for path in Path('/proc').glob('[0-9]*/stat'):
        try:
            fields = path.read_text().rpartition(')')[2].split()
        except OSError:
            continue  # it ended meanwhile
        if int(fields[3]) == session and fields[0] != 'Z':
            found.append(int(path.parent.name))
    return found
