"""The node's messages: CameraInfo and diagnostics."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header

from dashcalib_ros.camera import Camera, ros_camera
from dashcalib_ros.judge import Check
from dashcalib_ros.report import NamedCamera
from dashcalib_ros.ros.news import NOTHING
from dashcalib_ros.ros.state import State, sigma_text
from dashcalib_ros.status import Status

OK, WARN, ERROR, STALE = (DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR,
                          DiagnosticStatus.STALE)


def camera_info(camera: Camera, header: Header, rectified: str) -> CameraInfo:
    """Return the camera as a message; rectified: as ros_camera()'s."""
    c = ros_camera(camera, rectified)
    width, height = c.image_size
    return CameraInfo(header=header, width=width, height=height,
                      distortion_model=c.distortion_model, d=c.d, k=c.k, r=c.r, p=c.p)


def uncalibrated(header: Header) -> CameraInfo:
    """Return an uncalibrated CameraInfo, K[0] = 0 (sensor_msgs). It replaces a latched one."""
    return CameraInfo(header=header)


@dataclass(frozen=True)
class Health:
    """The content of the diagnostics. Counts are of images, since the start.

    published: the camera that is published now. stale: it was given up. verdict, reasons: of
    the last calibration. silent_s: s since the last image, None before the first. listening:
    False for a managed node that is not active. changes, suspicions: of the camera in use, in
    words; misfit: why the calibration no longer fits it, '' where it does. check: with check_only,
    what was found. confirmed: False for one of a file until turns agree with it.
    """

    state: State
    wanted: int
    topic: str
    reliability: str
    status: Status = NOTHING
    stage: str = ''
    published: NamedCamera | None = None
    stale: bool = False
    verdict: str = ''
    reasons: tuple[str, ...] = ()
    silent_s: float | None = None
    listening: bool = True
    file: str = ''
    warnings: tuple[str, ...] = ()
    counts: Mapping[str, int] = field(default_factory=dict)
    changes: tuple[str, ...] = ()
    suspicions: tuple[str, ...] = ()
    misfit: str = ''
    check: Check | None = None
    confirmed: bool = True


# s; a camera that is silent for longer has stopped
SILENT_S = 5.0


def diagnostic_status(health: Health, name: str, hardware_id: str) -> DiagnosticStatus:
    """Return the status of one camera."""
    level, message = _summary(health)
    status = health.status
    values = {
        'state': health.state,
        'stage': health.stage,
        'turns found': status.turns,
        'turns stored': status.stored,
        'turns built': status.built,
        'turns wanted': health.wanted,
        'yaw (deg)': f'{status.yaw_deg:.0f}',
        'percent': percent(health),
        'turning magnitude': f'{status.magnitude:.4f}',
        'standing': status.standing,
        'verdict': health.verdict,
        'reasons': '; '.join(health.reasons),
        'published': sigma_text(health.published) if health.published else 'nothing',
        'calibration': ('' if health.published is None
                        else 'confirmed' if health.confirmed else 'unconfirmed'),
        'camera model': health.published.camera.model if health.published else '',
        'sigma fx (px)': _sigma(health.published),
        'file': health.file,
        'topic': health.topic,
        'reliability': health.reliability,
        'warnings': '; '.join(health.warnings),
        'check': health.check.answer if health.check else '',
        'check reasons': '; '.join(health.check.reasons) if health.check else '',
        'change': '; '.join(health.changes),
        'suspected change': '; '.join(health.suspicions),
        **health.counts,
    }
    return DiagnosticStatus(
        level=level, name=name, hardware_id=hardware_id, message=message,
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])


def percent(health: Health) -> int:
    """Return how much of the evidence for the next calibration is there."""
    return min(100, round(100 * health.status.built / health.wanted))


def _summary(health: Health) -> tuple[bytes, str]:
    status = health.status
    turns = (f'{min(status.built, health.wanted)} of {health.wanted} turns, '
             f'{status.yaw_deg:.0f}° of yaw')
    if not health.listening:
        return WARN, 'inactive: the node subscribes no images until it is activated'
    if health.silent_s is None or health.silent_s > SILENT_S:
        since = 'yet' if health.silent_s is None else f'for {health.silent_s:.0f} s'
        return STALE, f'no image on {health.topic} {since}'
    if health.stale:
        return ERROR, f'the published calibration is contradicted; new turns: {turns}'
    if health.warnings:
        return WARN, f'{health.state}: {health.warnings[0]}'
    if health.misfit:
        return WARN, health.misfit
    if health.check is not None:
        return _checked(health.check, turns)
    if health.published is not None:
        state = 'calibrated' if health.confirmed else 'calibrated, unconfirmed'
        return OK, f'{state}; {turns} for the next check of it'
    if health.state == 'calibrating':
        return WARN, f'calibrating with {turns}: {health.stage}'
    if health.state == 'refused_so_far':
        why = health.reasons[0] if health.reasons else health.verdict
        return WARN, f'not calibrated, {turns}; so far {health.verdict}: {why}'
    return WARN, f'not calibrated yet: {turns}'


def _checked(found: Check, turns: str) -> tuple[bytes, str]:
    """Return level and message about a driver's calibration of which no change is known."""
    if found.answer == 'wrong':
        return WARN, f'the calibration is wrong: {found.reasons[0]}'
    if found.answer == 'right':
        return OK, f'the calibration is right; {turns} for the next check'
    return OK, f'checking the calibration, {turns}: {found.reasons[0]}'


def _sigma(camera: NamedCamera | None) -> str:
    return '' if camera is None or camera.sigma is None else f'{camera.sigma["fx"]:.3f}'
