# SPDX-License-Identifier: Apache-2.0
"""The topics and services of all programs, each in one place; no ROS is imported.

The endpoints are made from these tables, and --help and docs/ros_interface.md are written from
them.
"""
from __future__ import annotations

from dataclasses import dataclass

CALIBRATOR, CHECKER, RIG = 'calibrator', 'checker', 'rig'
# those of one camera
OF_CAMERA = (CALIBRATOR, CHECKER)
PROGRAMS = (*OF_CAMERA, RIG)


@dataclass(frozen=True)
class Topic:
    """A topic. name: as the code has it, before remapping; type: of its messages.

    about: what it has, for users. depth, latched, reliable: the quality of service; all are kept
    last. programs: that have it. always: published while the node is inactive, too.
    """

    name: str
    type: str
    about: str
    depth: int = 10
    latched: bool = False
    reliable: bool = True
    programs: tuple[str, ...] = OF_CAMERA
    always: bool = False

    @property
    def qos(self) -> str:
        """Return its quality of service in words."""
        return (f'{"reliable" if self.reliable else "best effort"}, depth {self.depth}'
                f'{", latched" if self.latched else ""}')


def _by_name(*topics: Topic) -> dict[str, Topic]:
    return {topic.name: topic for topic in topics}


TF_STATIC = '/tf_static'
PUBLISHED = _by_name(
    Topic('camera_info', 'sensor_msgs/msg/CameraInfo',
          'one for each image, with its header; none before a calibration is accepted',
          programs=(CALIBRATOR,)),
    Topic('~/calibration', 'sensor_msgs/msg/CameraInfo',
          'the calibration in use; K[0] = 0 after it was withdrawn', 1, latched=True,
          programs=(CALIBRATOR,)),
    Topic('~/check', 'diagnostic_msgs/msg/DiagnosticArray',
          "whether the driver's calibration is right: values answer, reasons, changes, rms_px, …; "
          'WARN where it is wrong', 1, latched=True, programs=(CHECKER,)),
    Topic('~/mount', 'geometry_msgs/msg/PoseWithCovarianceStamped',
          "the pose of the camera's optical frame in base_frame (REP-103); what is not known is 0 "
          'with a variance of 1e6 m²', 1, latched=True, programs=(CALIBRATOR,)),
    Topic(TF_STATIC, 'tf2_msgs/msg/TFMessage',
          'with publish_tf: base_frame to camera_link to the optical frame when the mounting is '
          'accepted, and again after it moved; of a rig, the optical frame of the base to the '
          'others', 1, latched=True, programs=(CALIBRATOR, RIG)),
    Topic('~/result', 'std_msgs/msg/String',
          'rig.json of the rig that was accepted last', 1, latched=True, programs=(RIG,)),
    Topic('~/turn_magnitude', 'std_msgs/msg/Float64',
          'how much the car turns, relative to the image width; for plots'),
    Topic('~/overlay/compressed', 'sensor_msgs/msg/CompressedImage',
          'tracked points, ego vehicle and state, while someone subscribes', 1),
    Topic('~/rectified/compressed', 'sensor_msgs/msg/CompressedImage',
          'the picture that P of camera_info describes, while someone subscribes', 1),
    Topic('/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray',
          'the state and what is missing, once a second, also while the node is inactive',
          programs=PROGRAMS, always=True))

# topics of sensors, which are subscribed with use_imu and so on, and the options of the command
# that have the same
SENSORS = {'imu': 'imu', 'odom': 'odom', 'fix': 'gps', 'temperature': 'temperature'}
SUBSCRIBED = _by_name(
    Topic('image_raw', 'sensor_msgs/msg/Image',
          'or image_raw/compressed with image_transport:=compressed; with video the first of '
          'image_raw/ffmpeg, image_raw/foxglove, image_raw, image_raw/compressed that has one', 5,
          reliable=False),
    Topic('camera_info', 'sensor_msgs/msg/CameraInfo',
          "the driver's, which is checked", 5, reliable=False, programs=(CHECKER,)),
    Topic(TF_STATIC, 'tf2_msgs/msg/TFMessage',
          'with publish_tf, and of a rig: a frame that has another parent gets none', 100,
          latched=True, programs=(CALIBRATOR, RIG)),
    Topic('NAME/calibrator/calibration', 'sensor_msgs/msg/CameraInfo',
          'of each of the cameras: whether its lens is accepted, and its frame', 1, latched=True,
          programs=(RIG,)),
    # best effort also receives from reliable publishers; a second of a fast gyro
    Topic('imu', 'sensor_msgs/msg/Imu', 'with use_imu: independent evidence for fx', 400,
          reliable=False),
    Topic('odom', 'nav_msgs/msg/Odometry', 'with use_odom: the speed, for the height of a camera '
                                           'and the metres of a rig', 400, reliable=False,
          programs=PROGRAMS),
    Topic('fix', 'sensor_msgs/msg/NavSatFix', 'with use_fix: independent evidence for fx', 400,
          reliable=False),
    Topic('temperature', 'sensor_msgs/msg/Temperature',
          'with use_temperature: of the camera; where fx follows it, camera_info is that of the '
          'temperature now', 10, reliable=False))

# what rclpy publishes and offers for each node with a lifecycle and parameters
OF_RCLPY = {
    'topics': ('/parameter_events', '/rosout', '~/transition_event'),
    'services': ('~/change_state', '~/get_state', '~/get_available_states',
                 '~/get_available_transitions', '~/get_transition_graph',
                 '~/describe_parameters', '~/get_parameter_types', '~/get_parameters',
                 '~/get_type_description', '~/list_parameters', '~/set_parameters',
                 '~/set_parameters_atomically')}


@dataclass(frozen=True)
class Service:
    """A service, of type std_srvs/srv/Trigger. about: what it does, for users."""

    name: str
    about: str
    programs: tuple[str, ...] = OF_CAMERA


SERVICES = (
    Service('~/calibrate', 'calibrates with the turns that exist, and answers when it is done: '
                           'success where the result is accepted, or says right or wrong'),
    Service('~/calibrate_now', 'begins the same and answers at once'),
    Service('~/reset', 'forgets the turns, also stored ones, and moves the calibration aside; of '
                       'a rig, forgets where the cameras sat', PROGRAMS),
    Service('~/save', 'writes the file of the calibration again', (CALIBRATOR,)))
# that a calibrator calls with commit
SET_CAMERA_INFO = 'set_camera_info'
