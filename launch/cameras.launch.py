# SPDX-License-Identifier: Apache-2.0
"""One calibrator for each camera of a car, and a node that places the cameras against the first.

ros2 launch dashcalib_ros cameras.launch.py \
    cameras:="front:=/front/image_raw rear:=/rear/image_raw"

For the latter, each calibrator keeps its turns in STORES/NAME (turns.store). The other arguments
are calibrator.launch.py's, and the same for all cameras. What one camera has alone is below
/NAME/calibrator in the parameter file.
"""
import re

from launch.actions import (
    DeclareLaunchArgument,
    GroupAction,
    IncludeLaunchDescription,
    OpaqueFunction,
)
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import LifecycleNode
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

ONE = PathJoinSubstitution([FindPackageShare('dashcalib_ros'), 'launch', 'calibrator.launch.py'])
# a name is a namespace, and part of a file's name
CAMERA = re.compile(r'([A-Za-z][A-Za-z0-9_]*):=(/?[A-Za-z][A-Za-z0-9_/]*)')


def cameras_in(text):
    """Return the image topic of each camera by its name. Raises ValueError."""
    found = {}
    for each in text.split():
        match = CAMERA.fullmatch(each)
        if match is None:
            raise ValueError(f'{each!r} is no camera: write cameras:="front:=/front/image_raw '
                             f'rear:=/rear/image_raw"')
        name, topic = match.groups()
        # a relative topic is in the camera's namespace
        topic = topic if topic.startswith('/') else f'/{name}/{topic}'
        if name in found or topic in found.values():
            raise ValueError(f'{each!r} has the name or the topic of another camera: each camera '
                             f'needs its own')
        found[name] = topic
    if not found:
        raise ValueError('no cameras: write cameras:="front:=/front/image_raw"')
    return found


def calibrators(context):
    """Return a calibrator for each camera; camera_info is beside the camera's images."""
    value = {name: LaunchConfiguration(name).perform(context)
             for name in ('cameras', 'rig', 'stores', 'odom')}
    cameras = cameras_in(value['cameras'])
    found, places = [], value['rig'] == 'true' and len(cameras) > 1
    for name, topic in cameras.items():
        own = {
            # its calibration has a file of this name
            'namespace': name, 'camera_name': name, 'image': topic,
            'camera_info': topic.rpartition('/')[0] + '/camera_info',
            **({'store': f'{value["stores"]}/{name}'} if places else {})}
        # a group each: the arguments of one camera are not those of the next
        found.append(GroupAction([IncludeLaunchDescription(
            PythonLaunchDescriptionSource(ONE), launch_arguments=own.items())]))
    if places:
        found.append(LifecycleNode(
            package='dashcalib_ros', executable='rig', name='rig', namespace='', output='screen',
            respawn=True, respawn_delay=2.0, respawn_max_retries=5,
            parameters=[{'cameras': ' '.join(cameras), 'stores': value['stores'],
                         'use_odom': bool(value['odom'])}],
            remappings=[('odom', value['odom'])] if value['odom'] else []))
    return found


def generate_launch_description():
    """Start one calibrator for each camera, in the camera's namespace, and the rig's node."""
    return LaunchDescription([
        DeclareLaunchArgument('cameras', description='NAME:=IMAGE_TOPIC of each camera, with '
                              'spaces between them; the topics without /compressed'),
        DeclareLaunchArgument('rig', default_value='true', description='false: the cameras are '
                              'not placed against the first one'),
        DeclareLaunchArgument('stores', default_value='~/.ros/dashcalib_turns', description='the '
                              'folder of the turns that place them, and of rig.json'),
        DeclareLaunchArgument('odom', default_value='', description='nav_msgs/Odometry of the '
                              'car, for metres'),
        OpaqueFunction(function=calibrators)])
