"""The nodes as managed ones: images are subscribed only while they are active."""
from __future__ import annotations

from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn

from dashcalib_ros.ros.calibrator_node import CalibratorNode
from dashcalib_ros.ros.check_node import CheckNode
from dashcalib_ros.ros.node import CameraNode


class Managed(LifecycleNodeMixin, CameraNode):  # type: ignore[misc]
    """Starts unconfigured. What it learned outlives deactivate; cleanup drops it.

    The kept calibration stays latched on ~/calibration in every state. camera_info is published
    beside images, hence only while the node is active.
    """

    def __init__(self) -> None:
        CameraNode.__init__(self, listen=False)
        LifecycleNodeMixin.__init__(self)
        self.answer_always()

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe the images."""
        self.listen(True)
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop listening; turns and calibration stay."""
        self.listen(False)
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin anew: with the kept calibration and without turns."""
        self.begin_anew()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop listening for good."""
        self.listen(False)
        return super().on_shutdown(state)


class ManagedCalibratorNode(Managed, CalibratorNode):
    """A managed node that calibrates."""


class ManagedCheckNode(Managed, CheckNode):
    """A managed node that checks."""
