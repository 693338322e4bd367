# SPDX-License-Identifier: Apache-2.0
"""ros2 launch dashcalib_ros calibrator.launch.py namespace:=front [image_transport:=compressed].

The other launch files include this one, which has the arguments of all.
"""
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    OpaqueFunction,
    RegisterEventHandler,
)
from launch.conditions import IfCondition
from launch.event_handlers import OnProcessStart
from launch.events import matches_action
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import LifecycleNode, Node
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState
from launch_ros.substitutions import FindPackageShare
from lifecycle_msgs.msg import Transition

from launch import LaunchDescription

ARGUMENTS = (
    ('program', 'calibrator', 'calibrator, or checker for the calibration of a driver'),
    ('namespace', '', 'the namespace of the camera, which also gives it its name'),
    ('camera_name', '', 'another name of the camera; overrides the parameter file'),
    ('image', 'image_raw', 'the image topic, without /compressed'),
    ('camera_info', 'camera_info', 'the topic on which the calibration is published'),
    ('store', '', 'the folder of turns.store; overrides the parameter file'),
    ('image_transport', 'raw', 'raw, compressed or video; overrides the parameter file'),
    ('use_sim_time', 'false', 'true for a bag played with --clock; overrides the parameter file'),
    ('config', PathJoinSubstitution([FindPackageShare('dashcalib_ros'), 'config',
                                     'calibrator.yaml']), 'the parameter file'),
    ('autostart', 'true', 'false: the node waits until its state is changed'),
    ('manage', 'false', 'true, with autostart:=false: this launch changes the state'),
    ('rviz', 'false', 'true starts RViz with the images, what the node draws, and the mounting'),
)
RVIZ = PathJoinSubstitution([FindPackageShare('dashcalib_ros'), 'config', 'dashcalib.rviz'])
# topics in RVIZ that are in the namespace
SHOWN = ('calibrator/overlay/compressed', 'calibrator/rectified/compressed', 'calibrator/mount')


def started(context):
    """Return the node, and what changes its state, also after it was started again."""
    value = {name: LaunchConfiguration(name) for name, _, _ in ARGUMENTS}
    own = {name: value[name] for name in ('image_transport', 'use_sim_time', 'autostart')}
    for name, parameter in (('camera_name', 'camera_name'), ('store', 'turns.store')):
        if given := value[name].perform(context):
            own[parameter] = given
    node = LifecycleNode(
        package='dashcalib_ros', executable=value['program'], name=value['program'],
        namespace=value['namespace'], output='screen',
        # a wrong parameter ends it each time
        respawn=True, respawn_delay=2.0, respawn_max_retries=5,
        parameters=[value['config'], own],
        remappings=[('image_raw', value['image']), ('camera_info', value['camera_info'])])

    def change(transition):
        return EmitEvent(event=ChangeState(lifecycle_node_matcher=matches_action(node),
                                           transition_id=transition),
                         condition=IfCondition(value['manage']))

    return [
        RegisterEventHandler(OnProcessStart(
            target_action=node, on_start=[change(Transition.TRANSITION_CONFIGURE)])),
        RegisterEventHandler(OnStateTransition(
            target_lifecycle_node=node, start_state='configuring', goal_state='inactive',
            entities=[change(Transition.TRANSITION_ACTIVATE)])),
        node]


def generate_launch_description():
    """Start one node, which configures and activates itself; include this for each camera."""
    value = {name: LaunchConfiguration(name) for name, _, _ in ARGUMENTS}
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=default, description=about)
          for name, default, about in ARGUMENTS),
        OpaqueFunction(function=started),
        Node(
            package='rviz2', executable='rviz2', name='rviz', namespace=value['namespace'],
            arguments=['-d', RVIZ], condition=IfCondition(value['rviz']),
            remappings=[('/image_raw', value['image']),
                        *((f'/{topic}', topic) for topic in SHOWN)]),
    ])
