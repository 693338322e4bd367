# SPDX-License-Identifier: Apache-2.0
"""One calibrator for each camera of a car.

ros2 launch dashcalib_ros cameras.launch.py \
    cameras:="front:=/front/image_raw rear:=/rear/image_raw"

The other arguments are calibrator.launch.py's, and the same for all cameras. What one camera has
alone is below /NAME/calibrator in the parameter file.
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
    found = []
    for name, topic in cameras_in(LaunchConfiguration('cameras').perform(context)).items():
        own = {
            # its calibration has a file of this name
            'namespace': name, 'camera_name': name, 'image': topic,
            'camera_info': topic.rpartition('/')[0] + '/camera_info'}
        # a group each: the arguments of one camera are not those of the next
        found.append(GroupAction([IncludeLaunchDescription(
            PythonLaunchDescriptionSource(ONE), launch_arguments=own.items())]))
    return found


def generate_launch_description():
    """Start one calibrator for each camera, in the camera's namespace."""
    return LaunchDescription([
        DeclareLaunchArgument('cameras', description='NAME:=IMAGE_TOPIC of each camera, with '
                              'spaces between them; the topics without /compressed'),
        OpaqueFunction(function=calibrators)])
