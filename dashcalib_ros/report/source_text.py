"""Reading small text files that a user names, with one clear error for all that can go wrong."""
from __future__ import annotations

from pathlib import Path

from dashcalib_ros.errors import InputError

LIMIT_BYTES = 16 * 2**20  # far more than a result.json has, far less than a bag given by mistake


def read_text(path: str | Path) -> str:
    """Return a calibration file's text. Raises InputError."""
    path = Path(path)
    try:
        with path.open('rb') as stream:
            data = stream.read(LIMIT_BYTES + 1)
    except FileNotFoundError as error:
        raise InputError(f'{path} does not exist; check the path') from error
    except OSError as error:
        raise InputError(f'cannot read {path} ({error.strerror}); check the path') from error
    if len(data) > LIMIT_BYTES:
        raise InputError(f'{path} is too large for a calibration; '
                         'give a result.json, a camera_info YAML or a truth JSON')
    try:
        return data.decode('utf-8-sig')
    except UnicodeDecodeError as error:
        raise InputError(f'{path} is not a text file; '
                         'give a result.json, a camera_info YAML or a truth JSON') from error
