# SPDX-License-Identifier: Apache-2.0
"""One turn -> one scene: tracks, chain, registration, adjustment. COLMAP is loaded when called."""
from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator

import numpy as np

from dashcalib_ros.arrays import Mask
from dashcalib_ros.config import Config
from dashcalib_ros.detect import Turn
from dashcalib_ros.reconstruct.scene import Draft, Scene


def reconstruct(turn: Turn, config: Config, valid: Mask | None = None) -> Scene | None:
    """Reconstruct one turn; None where its pictures give no scene.

    valid: (h, w), False where the ego vehicle is; None for everywhere.
    """
    begun = draft(turn, config, valid)
    return None if begun is None else finish(turn, config, begun)


def draft(turn: Turn, config: Config, valid: Mask | None = None) -> Draft | None:
    """Do the first half of reconstruct(): the tracks, and the focal length to start from."""
    from dashcalib_ros.reconstruct.build import draft_scene
    with _numerical_failures(turn):
        return draft_scene(turn, config, valid)
    return None


def finish(turn: Turn, config: Config, begun: Draft) -> Scene | None:
    """Do the second half of reconstruct(); the turn needs the images of begun's keyframes only."""
    from dashcalib_ros.reconstruct.build import finish_scene
    with _numerical_failures(turn):
        return finish_scene(turn, begun, config)
    return None


def load(engine: str) -> None:
    """Import all that reconstruct() needs with an engine, COLMAP or OPENCV of config."""
    import dashcalib_ros.reconstruct.build  # noqa: F401
    from dashcalib_ros.reconstruct.geometry import engine_named
    engine_named(engine)


@contextlib.contextmanager
def _numerical_failures(turn: Turn) -> Iterator[None]:
    """Catch numerical failures from bad pictures: such a turn has no scene, others may."""
    import cv2
    try:
        yield
    except (np.linalg.LinAlgError, cv2.error) as error:
        # shown with --verbose only; the result lists the turns that were not reconstructed
        print(f'the turn at frame {turn.center} was not reconstructed: {error}', file=sys.stderr)
