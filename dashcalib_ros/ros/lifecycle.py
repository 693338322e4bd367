"""The node as a managed one: images are subscribed only while it is active."""
from __future__ import annotations

from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn

from dashcalib_ros.ros.node import CalibratorNode


class LifecycleCalibratorNode(LifecycleNodeMixin, CalibratorNode):  # type: ignore[misc]
    """Starts unconfigured. What it learned outlives deactivate; cleanup drops it.

    The kept calibration stays latched on ~/calibration in every state. camera_info is published
    beside images, hence only while the node is active.
    """

    def __init__(self) -> None:
        CalibratorNode.__init__(self, listen=False)
        LifecycleNodeMixin.__init__(self)
        self.answer_always()

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe the images."""
        self._images.start()
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop listening; turns and calibration stay."""
        self._images.stop()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin anew: with the kept calibration and without turns."""
        self._forget(keep_stored=True)
        self._in_use.load()
        self._set_goal()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop listening for good."""
        self._images.stop()
        return super().on_shutdown(state)
