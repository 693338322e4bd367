"""One picture of each turn, for people: small, and of a keyframe, so that tracks fit on it."""
from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from dashcalib_ros.arrays import GreyImage, Pixels
from dashcalib_ros.detect.turn import Turn
from dashcalib_ros.reconstruct.scene import Scene

# px; wider pictures are made smaller: several of them go into one report
WIDTH = 720


@dataclass(frozen=True)
class TurnPicture:
    """frame: its index among the input's frames; stamp_ns: its time.

    image: uint8, at most WIDTH wide; (h, w) grey, or (h, w, 3) BGR.
    """

    frame: int
    stamp_ns: int
    image: Pixels

    def coloured(self, image: Pixels) -> TurnPicture:
        """Return the same with the input's own image of this frame, grey or in colour."""
        size = self.image.shape[1::-1]
        return replace(self, image=cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def picture_of(turn: Turn, scene: Scene | None) -> TurnPicture | None:
    """Return the picture at the turn's centre: of a registered keyframe, if there is a scene.

    None where the turn has no frames any more.
    """
    shown = {frame.index: frame for frame in turn.frames}
    if scene is not None:
        registered = scene.tracks.frames[scene.structure.registered]
        shown = {index: shown[index] for index in map(int, registered) if index in shown}
    if not shown:
        return None
    index = min(shown, key=lambda index: abs(index - turn.center))
    return TurnPicture(index, shown[index].stamp_ns, _small(shown[index].image))


def _small(image: GreyImage) -> GreyImage:
    height, width = image.shape
    if width <= WIDTH:
        # a view may keep much more than this picture in memory
        return np.array(image)
    size = (WIDTH, max(1, round(height * WIDTH / width)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
