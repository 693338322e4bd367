"""What straight lines add to a check: a witness that knows nothing of the turns."""
from __future__ import annotations

from dataclasses import replace

from dashcalib_ros.camera import Camera
from dashcalib_ros.config import Config
from dashcalib_ros.detect import Bend, Lines, bend
from dashcalib_ros.input.scale import Scale
from dashcalib_ros.judge.check import Check
from dashcalib_ros.judge.verdict import lines_contradict


def with_lines(found: Check, given: Camera, lines: Lines, image_size: tuple[int, int],
               config: Config) -> Check:
    """Return a check with what straight lines say of the given camera, if there are enough.

    lines: of the resized pictures. image_size: of the drive's. Lines alone call no camera wrong:
    where they contradict one that the turns call right, the drive cannot tell.
    """
    if given.image_size != image_size:
        return found
    scale = Scale.of(image_size, config)
    said = bend(lines, given.resized(1 / scale.px, scale.size(image_size)), config.lines)
    if said is None:
        return found
    said = said.resized(scale.px)
    against = lines_contradict(said, image_size[0], config.verdict)
    answer = 'cannot tell' if against and found.answer == 'right' else found.answer
    return replace(found, answer=answer, reasons=(*found.reasons, _text(said, against)),
                   straight_lines=said)


def _text(said: Bend, against: bool) -> str:
    return (f'{said.lines} upright lines (poles, edges of houses) '
            f'{"contradict" if against else "do not contradict"} its distortion: they ask for k1 '
            f'{said.k1:+.3f} ± {said.sigma:.3f}')
