"""ros2 launch dashcalib_ros calibrator_lifecycle.launch.py [namespace:=front] ...

The node waits for a lifecycle manager. With manage:=true this file is one: it configures and
activates the node, also after it was started again.
"""
from launch.actions import DeclareLaunchArgument, EmitEvent, RegisterEventHandler
from launch.conditions import IfCondition
from launch.event_handlers import OnProcessStart
from launch.events import matches_action
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import LifecycleNode
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState
from launch_ros.substitutions import FindPackageShare
from lifecycle_msgs.msg import Transition

from launch import LaunchDescription

ARGUMENTS = (
    ('program', 'calibrator', 'calibrator, or checker for the calibration of a driver'),
    ('namespace', '', 'the namespace of the camera, which also gives it its name'),
    ('image', 'image_raw', 'the image topic, without /compressed'),
    ('camera_info', 'camera_info', 'the topic on which the calibration is published'),
    ('config', PathJoinSubstitution([FindPackageShare('dashcalib_ros'), 'config',
                                     'calibrator.yaml']), 'the parameter file'),
    ('manage', 'true', 'false: another program changes the state of the node'),
)


def generate_launch_description():
    """Start one node as a lifecycle node."""
    value = {name: LaunchConfiguration(name) for name, _, _ in ARGUMENTS}
    node = LifecycleNode(
        package='dashcalib_ros', executable=value['program'], name=value['program'],
        namespace=value['namespace'], output='screen',
        respawn=True, respawn_delay=2.0, respawn_max_retries=5,
        parameters=[value['config'], {'autostart': False}],
        remappings=[('image_raw', value['image']), ('camera_info', value['camera_info'])])

    def change(transition):
        return EmitEvent(event=ChangeState(lifecycle_node_matcher=matches_action(node),
                                           transition_id=transition),
                         condition=IfCondition(value['manage']))

    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=default, description=about)
          for name, default, about in ARGUMENTS),
        RegisterEventHandler(OnProcessStart(
            target_action=node, on_start=[change(Transition.TRANSITION_CONFIGURE)])),
        RegisterEventHandler(OnStateTransition(
            target_lifecycle_node=node, start_state='configuring', goal_state='inactive',
            entities=[change(Transition.TRANSITION_ACTIVATE)])),
        node,
    ])
