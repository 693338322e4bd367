"""One image of the camera: decoded, searched for turns, and handed on to who watches."""
from __future__ import annotations

from typing import Any

from dashcalib_ros.arrays import GreyImage
from dashcalib_ros.errors import InputError
from dashcalib_ros.input import Frame
from dashcalib_ros.input.decode import BitDepth, decode
from dashcalib_ros.ros.bank import Job
from dashcalib_ros.ros.news import Listener, Picture, call, named
from dashcalib_ros.status import Status


def whole(message: Any, size: tuple[int, int], depth: BitDepth | None = None) -> GreyImage:
    """Decode a message whose header says this size; raises InputError if it is not so."""
    image = decode(message, depth)
    if image.shape[::-1] != size:
        raise InputError(f'an image is {image.shape[1]}x{image.shape[0]} but its header says '
                         f'{size[0]}x{size[1]}: the camera driver is broken')
    return image


def detect(job: Job, tell: Listener) -> Status | None:
    """Search an image for turns; None, and told, where it cannot be used."""
    try:
        image = whole(job.message, job.size, job.bank.depth)
        calibrator = job.bank.calibrator
        status = calibrator.push(Frame(job.index, job.stamp_ns, image, job.frame_id))
        if tell.watching():
            tell.picture(Picture(job.message.header, image, calibrator.view()))
    except InputError as error:
        call(tell.trouble, 'undecodable', str(error))
        return None
    except Exception as error:
        call(tell.trouble, 'failed', f'an image could not be used: {named(error)}')
        return None
    return status
