"""The libraries of the extra `fleet`, which the rest of the package does without."""
from __future__ import annotations

import importlib
from types import ModuleType

from dashcalib_ros.errors import ConfigError


def needs(library: str, what: str) -> ModuleType:
    """Import a library of the extra; raises ConfigError that says how to install it."""
    found = has(library)
    if found is None:
        raise ConfigError(f"{what} need {library}: install it with pip install "
                          f"'dashcalib_ros[fleet]'")
    return found


def has(library: str) -> ModuleType | None:
    """Import a library of the extra, if it is installed."""
    try:
        return importlib.import_module(library)
    except ModuleNotFoundError as error:
        if error.name != library.partition('.')[0]:
            raise
        return None
