# SPDX-License-Identifier: Apache-2.0
"""Fakes whose calls are checked against what they stand for: a changed signature fails here."""
from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, TypeVar

from rosbags.typesys import Stores, get_typestore

T = TypeVar('T', bound=type)
F = TypeVar('F', bound=Callable[..., Any])
TYPES = get_typestore(Stores.ROS2_JAZZY).types


def stands_in_for(real: type) -> Callable[[T], T]:
    """Check each public method of a class, and __init__, against the real class."""
    def check(fake: T) -> T:
        for name, value in vars(fake).items():
            if inspect.isfunction(value) and (name == '__init__' or not name.startswith('_')):
                called_like(getattr(real, name))(value)
        return fake
    return check


def called_like(real: Callable[..., Any]) -> Callable[[F], F]:
    """Check that a function has the real one's parameters: names, order, kinds, which are needed.

    Those of the real one that nobody needs to give may be missing at the end.
    """
    def check(fake: F) -> F:
        theirs, ours = _parameters(real), _parameters(fake)
        rest = theirs[len(ours):]
        if theirs[:len(ours)] != ours or not all(optional for *_, optional in rest):
            raise TypeError(f'{fake.__qualname__}{inspect.signature(fake)} is not called like '
                            f'{real.__qualname__}{inspect.signature(real)}')
        return fake
    return check


def _parameters(function: Callable[..., Any]) -> list[tuple[str, object, bool]]:
    return [(each.name, each.kind, each.default is not inspect.Parameter.empty)
            for each in inspect.signature(function).parameters.values()]


def image_message(**fields: Any) -> Any:
    """Return a sensor_msgs/Image; raises TypeError for fields that it has not, or that lack."""
    return TYPES['sensor_msgs/msg/Image'](header=None, **fields)


def compressed_message(**fields: Any) -> Any:
    """Return a sensor_msgs/CompressedImage, checked likewise."""
    return TYPES['sensor_msgs/msg/CompressedImage'](header=None, **fields)
