"""Static transforms, with tf2_ros; ROS 2 from pip has none."""
from __future__ import annotations

from collections.abc import Callable

from geometry_msgs.msg import TransformStamped

from dashcalib_ros.ros.endpoints import Endpoints
from dashcalib_ros.ros.interface import TF_STATIC


def static_broadcaster(endpoints: Endpoints) -> Callable[[TransformStamped], None] | None:
    """Return what sends static transforms; None, with a warning, where tf2_ros is missing."""
    try:
        from tf2_ros import StaticTransformBroadcaster
    except ImportError:
        endpoints.complaints.once('publish_tf needs tf2_ros, which is not installed: apt install '
                                  'ros-$ROS_DISTRO-tf2-ros-py; ~/mount has the pose')
        return None
    # tf2_ros takes no overrides of the QoS itself
    broadcaster = StaticTransformBroadcaster(endpoints.node, endpoints.overridden(TF_STATIC))
    endpoints.at_end(endpoints.node.destroy_publisher, broadcaster.pub_tf)
    send: Callable[[TransformStamped], None] = broadcaster.sendTransform
    return send
