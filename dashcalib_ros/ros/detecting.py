"""One image of the camera: decoded, searched for turns, and handed on to who watches."""
from __future__ import annotations

from dashcalib_ros.errors import InputError
from dashcalib_ros.frames import Frame
from dashcalib_ros.frames.decode import decode
from dashcalib_ros.ros.bank import Job
from dashcalib_ros.ros.news import Listener, Picture, call, named
from dashcalib_ros.status import Status


def detect(job: Job, tell: Listener) -> Status | None:
    """Search an image for turns; None, and told, where it cannot be used."""
    try:
        image = decode(job.message, job.bank.depth)
        if image.shape[::-1] != job.size:
            raise InputError(
                f'an image is {image.shape[1]}x{image.shape[0]} but its header says '
                f'{job.size[0]}x{job.size[1]}: the camera driver is broken')
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
