"""/diagnostics, once a second: what the node does, what is missing, and what is wrong."""
from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.qos import QoSProfile

from dashcalib_ros.ros.camera_in_use import CameraInUse
from dashcalib_ros.ros.complaints import Complaints
from dashcalib_ros.ros.images import ImageInput
from dashcalib_ros.ros.intake import CURES, Intake
from dashcalib_ros.ros.learner import Learner
from dashcalib_ros.ros.messages import Health, diagnostic_status
from dashcalib_ros.ros.preview import Preview
from dashcalib_ros.ros.qos import make_publisher
from dashcalib_ros.ros.state import state_of
from dashcalib_ros.ros.waiting import Waiting

PERIOD_S = 1.0
# further kinds of problems than those of CURES, which come with a message of their own
TROUBLES = ('undecodable', 'strays', 'failed', 'failed_calibrations', 'failed_watches', 'unsaved',
            'store', 'workers', 'failed_callbacks', 'preview', 'other_calibrations')


class Diagnosis:
    """Looks at the node's parts and publishes what it sees; the overlay shows it, too."""

    def __init__(self, node: Node, name: str, complaints: Complaints, images: ImageInput,
                 intake: Intake, in_use: CameraInUse, preview: Preview) -> None:
        """name: the camera's."""
        self._node = node
        self._name = name
        self._complaints = complaints
        self._images = images
        self._intake = intake
        self._in_use = in_use
        self._preview = preview
        self._waiting = Waiting(node, images)
        self._publisher = make_publisher(node, DiagnosticArray, '/diagnostics',
                                         QoSProfile(depth=10))

    def tick(self, learner: Learner, wanted: int) -> None:
        """Publish; wanted: the turns that the next calibration needs."""
        self._intake.complain(learner.dropped)
        if self._images.listening:
            self._waiting.look(self._intake.silent_s)
        node = self._node.get_fully_qualified_name().strip('/')
        status = diagnostic_status(self.health(learner, wanted), f'{node}: camera calibration',
                                   self._name)
        used = self._in_use.camera
        self._preview.tell(status.message, used.camera if used else None)
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)

    def health(self, learner: Learner, wanted: int) -> Health:
        """Return what is published."""
        activity, in_use, intake = learner.activity(), self._in_use, self._intake
        verdict = in_use.verdict
        answer = in_use.answer
        checking = answer is not None
        state = 'checking' if checking else state_of(
            in_use.trusted is not None, activity.calibrating,
            verdict is not None and verdict.level != 'accepted')
        counts = {'received': intake.received,
                  'camera_info published': in_use.published,
                  **{kind: self._complaints.counts[kind] for kind in (*CURES, *TROUBLES)},
                  'contradictions': in_use.contradictions,
                  'pictures published': self._preview.published}
        return Health(
            state, wanted, self._images.topic, self._images.reliability, activity.status,
            activity.stage, None if checking else in_use.camera, in_use.stale,
            verdict.level if verdict else '',
            verdict.reasons if verdict else (), intake.silent_s,
            self._images.listening, in_use.file, tuple(self._warnings()), counts,
            in_use.changes.texts, tuple(map(str, in_use.changes.suspected)),
            in_use.changes.misfit, answer, in_use.confirmed)

    def _warnings(self) -> list[str]:
        warnings = self._in_use.warnings()
        if self._images.publishers > 1:
            warnings.append(f'{self._images.publishers} publishers on {self._images.topic}: '
                            f'remap all but one camera')
        return warnings
