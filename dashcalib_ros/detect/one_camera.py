# SPDX-License-Identifier: Apache-2.0
"""Whether all images of a stream are of one camera: some of the skipped ones are compared.

Images that come faster than tracking.rate are skipped, and all images used may be of one camera
while the skipped ones are of another. So one of these is compared now and then: its points must
lie where the images before and after it predict. Let u be a point's step between these two, and v
its step from the first to the skipped image. The car's speed hardly changes in so short a time;
the road shifts and turns the picture a little, now to one side, now to the other:

    v = share u + shift + roll + zoom

Another lens zooms the picture, another mounting shifts or turns it, each time by the same; of
another view no point is found again. Measured on rendered and real drives (lessons.md): sound
cameras zoom by 0.1 % and shift by 1 px, a lens 3 % longer by 3.0 ± 0.1 %.

Both pictures of a stereo camera may also be in one image: then one half shows what the other does.
"""
from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from dashcalib_ros.arrays import Floats, Floats32, GreyImage, Mask
from dashcalib_ros.detect.continuity import MIN_POINTS, fitted_steps
from dashcalib_ros.detect.points import Tracking, follow_points
from dashcalib_ros.errors import InputError
from dashcalib_ros.input.stamps import Looks

APART = 'record each camera separately, with one topic per camera'


@dataclass(frozen=True)
class OtherCamera:
    """Another camera in the stream, seen in images that are skipped, or from one image on.

    shown: number of the newest comparisons that show it; looks: number of all of these; 0 where
    it is not seen in skipped ones. what: they show, in words.
    """

    shown: int
    looks: int
    what: str

    def __str__(self) -> str:
        if not self.looks:
            return f'the images are of two cameras: {self.what}'
        return (f'the images are of two cameras: of {self.looks} skipped images that were '
                f'compared, {self.shown} show {self.what}')


# looks that count, and how many of them must show the same other camera: where it sends every
# fourth of the images between, a quarter of the looks
RECENT, SAME = 20, 5
# of the points that the images before and after have: another view has fewer of them, and fewer of
# these on their way. Of sound cameras 0.5 to 1 are found. Where the images between were mixed from
# those around, as for another rate, few are found, but on their way
LEAST_FOUND, LEAST_NEAR = 0.35, 0.06
# of the working width, and of the median point's step; an image that is off by more is of another
# camera, where others are off by the same
OFF_WIDTH, OFF_STEP = 0.005, 0.15
# of their median; looks that are nearer to it show the same camera
ALIKE = 0.5
# of the points; where so few go on into the next image and so many into its mirror image, that is
# mirrored
LOST, MIRRORED = 0.1, 0.5
# of the steps between images of a drive; a longer one may lose all points
USUAL_STEP = 1.5
# of the grey values' spread; a darker image, as black ones of a broken driver, shows nothing
LEAST_CONTRAST = 0.3


class OneCamera:
    """Compares skipped images with those around them.

    other: the other camera, once it was seen. mixed: whether the newest comparisons show it.
    jump: the number of the first image that shows another view than the one before, with no gap
    in time, where the images before and after it go on.
    """

    def __init__(self) -> None:
        self.other: OtherCamera | None = None
        # of each look: None for another view; else how far the image is off, as _off() has it, and
        # whether that is too far
        self._looks: deque[tuple[Floats, bool] | None] = deque(maxlen=RECENT)
        self.mixed = False
        self.jump: int | None = None
        # of the last two images: the share of points that was found in each; and the number of the
        # last one, where it may be a jump
        self._followed = (0.0, 0.0)
        self._jumped: int | None = None

    def look(self, images: Sequence[GreyImage], before: Floats32, after: Floats32,
             tracking: Tracking) -> None:
        """Compare a skipped image.

        images: the one before it, and itself. before, after: (n, 2) px, the same points in the
        images before and after it.
        """
        first, between = images
        if len(before) < MIN_POINTS or between.std() < LEAST_CONTRAST * first.std():
            return
        there, found = follow_points(first, between, before, tracking)
        at, half, last = (np.asarray(xy[found], np.float64) for xy in (before, there, after))
        if found.mean() >= LEAST_FOUND:
            size = np.array(first.shape[::-1])
            off = _off(at - size / 2, half - at, last - at, size[0] / 2)
            step = np.linalg.norm(last - at, axis=1)
            most = OFF_WIDTH * size[0] + OFF_STEP * float(np.median(step))
            self._looks.append((off, bool(np.linalg.norm(off) * size[0] / 2 > most)))
        elif _near(half - at, last - at).sum() < LEAST_NEAR * len(before):
            self._looks.append(None)
        else:
            self._looks.append((np.zeros(4), False))
        now = self._judge()
        self.mixed, self.other = now is not None, now or self.other

    def look_at_next(self, images: Sequence[GreyImage], before: Floats32, followed: float,
                     index: int, tracking: Tracking, joint: bool) -> None:
        """See whether an image that does not go on from the one before is of another camera.

        images: the one before, and this one, whose number is index. before: (n, 2) px, the points
        in the one before; followed: the share of them that was found in this one. joint: whether
        something may be missing between them.
        """
        earlier, last = self._followed
        if self.jump is None and last < LOST and earlier > MIRRORED and followed > MIRRORED:
            self.jump = self._jumped
        self._followed, self._jumped = (last, followed), None
        first, now = images
        if (len(before) < MIN_POINTS or not followed < LOST
                or now.std() < LEAST_CONTRAST * first.std()):
            return
        there = np.array(before)
        there[:, 0] = first.shape[1] - 1 - there[:, 0]
        _, found = follow_points(np.ascontiguousarray(first[:, ::-1]), now, there, tracking)
        if found.mean() > MIRRORED:
            self.other = self.other or OtherCamera(
                1, 0, f'image {index} is mirrored, and the one before is not')
        elif not joint:
            self._jumped = index

    def _judge(self) -> OtherCamera | None:
        views = sum(each is None for each in self._looks)
        if views >= SAME:
            return OtherCamera(views, len(self._looks), 'another view')
        off = [each[0] for each in self._looks if each is not None and each[1]]
        if len(off) < SAME:
            return None
        middle = np.median(off, axis=0)
        alike = np.linalg.norm(off - middle, axis=1) < ALIKE * np.linalg.norm(middle)
        if alike.sum() < SAME:
            return None
        return OtherCamera(int(alike.sum()), len(self._looks), _in_words(middle))


def _in_words(off: Floats) -> str:
    """Return in words what an image shows; off: (4,) as _off() returns it."""
    zoom = float(off[3])
    if abs(zoom) < np.linalg.norm(off[:3]):
        return 'the same view from another mounting'
    return f'the same view {100 * abs(zoom):.1f} % {"larger" if zoom > 0 else "smaller"}'


# px, and of its step: how far from its way a point may be found
NEAR_PX, NEAR_STEP = 2.0, 0.15


def _near(to_between: Floats, to_after: Floats) -> Mask:
    """Return (n,) whether points lie near their way from the image before to the one after.

    to_between, to_after: (n, 2) px, their steps.
    """
    length = np.maximum(np.linalg.norm(to_after, axis=1, keepdims=True), 1e-6)
    share = np.clip((to_between * to_after).sum(1, keepdims=True) / length**2, 0.0, 1.0)
    aside = np.linalg.norm(to_between - share * to_after, axis=1)
    return np.asarray(aside < NEAR_PX + NEAR_STEP * length[:, 0])


# px², as in fitted_steps(): in a turn the car's motion explains a shift before a mounting does
SPEED_PRIOR, CAMERA_PRIOR = 1e-3, 1e-4


def _off(at: Floats, to_between: Floats, to_after: Floats, half: float) -> Floats:
    """Return how far the image between is off: (4,) two shifts, of half a width, roll and zoom.

    at: (n, 2) px in the image before, from its centre; to_between, to_after: (n, 2) px, the
    points' steps from there; half: px, half a width.
    """
    around = at / half
    one, none = np.ones(len(at)), np.zeros(len(at))
    design = np.stack([to_after, np.stack([one, none], 1), np.stack([none, one], 1),
                       np.stack([-around[:, 1], around[:, 0]], 1), around], axis=2)
    found = fitted_steps(design, to_between, np.zeros(5), np.array(
        [SPEED_PRIOR, *[CAMERA_PRIOR] * 4]))
    return np.asarray(found.params[1:] / half)


# px: least width and height of half an image, side of a patch, how far apart the rows may be; of
# the width, how far apart the columns may be
HALF, PATCH, ROWS, COLUMNS = (160, 100), 20, 2, 0.25
# minimum number of patches of a half that tell; correlation of those found in the other half, and
# their share; images that all show it. Of one camera's pictures 0 to 0.54 are found, mostly
# none, of stereo pictures 0.86 to 1
LEAST_PATCHES, FOUND_AGAIN, LEAST_SHARE, ALL = 12, 0.8, 0.7, 5


class TwoPictures:
    """Looks once a second whether the images show two pictures, side by side or stacked."""

    def __init__(self) -> None:
        self._looks = Looks()
        self._shown = {'side by side': 0, 'one above the other': 0}
        self._found: InputError | None = None

    def push(self, image: GreyImage, stamp_ns: int) -> None:
        """Take an image of a moving car; raises InputError where all so far show two pictures."""
        if self._shown and self._found is None and self._looks.due(stamp_ns):
            self._look(image)
        if self._found is not None:
            raise self._found

    def _look(self, image: GreyImage) -> None:
        height, width = image.shape[0] // 2, image.shape[1] // 2
        halves = {'side by side': (image[:, :width], image[:, -width:]),
                  'one above the other': (image[:height], image[-height:])}
        for how in list(self._shown):
            share = _share(*halves[how])
            if share is None:
                continue
            self._shown[how] += 1
            if share < LEAST_SHARE:
                del self._shown[how]
            elif self._shown[how] >= ALL:
                crop = 'iw/2:ih:0:0' if how == 'side by side' else 'iw:ih/2:0:0'
                self._found = InputError(
                    'E-TWO-PICTURES', f'each image shows two pictures {how}, as of a stereo '
                    f'camera: cut one of them out (ffmpeg -i IN -vf crop={crop} OUT.mp4; in ROS '
                    f'image_proc crop_decimate) and calibrate that')


def _share(one: GreyImage, other: GreyImage) -> float | None:
    """Return the share of patches of a picture that another one shows, None for too few.

    None for small pictures, too: enlarged, all patches are alike.
    """
    height, width = one.shape
    scale = max(HALF[0] / width, HALF[1] / height)
    if scale > 1:
        return None
    size = round(width * scale), round(height * scale)
    apart = round(COLUMNS * size[0])
    small, there = (cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in (one, other))
    corners = cv2.goodFeaturesToTrack(small, 40, 0.05, PATCH // 2, blockSize=7)
    half, found = PATCH // 2, []
    for x, y in (np.empty((0, 2), int) if corners is None else np.rint(corners[:, 0]).astype(int)):
        top, left = y - half - ROWS, x - half
        if top < 0 or left < 0 or top + PATCH + 2 * ROWS > size[1] or left + PATCH > size[0]:
            continue
        patch = small[y - half:y + half, left:left + PATCH]
        around = there[top:top + PATCH + 2 * ROWS, max(0, left - apart):left + PATCH + apart]
        found.append(cv2.matchTemplate(around, patch, cv2.TM_CCOEFF_NORMED).max() > FOUND_AGAIN)
    return float(np.mean(found)) if len(found) >= LEAST_PATCHES else None
