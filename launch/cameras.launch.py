"""One calibrator for each camera of a car.

ros2 launch dashcalib_ros cameras.launch.py \
    cameras:="front:=/front/image_raw rear:=/rear/image_raw"
"""
import re

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

ARGUMENTS = (
    ('cameras', None, 'NAME:=IMAGE_TOPIC of each camera, with spaces between them; the topics '
                      'without /compressed'),
    ('image_transport', 'raw', 'raw, compressed or video; overrides the parameter file'),
    ('use_sim_time', 'false', 'true for a bag played with --clock; overrides the parameter file'),
    ('config', PathJoinSubstitution([FindPackageShare('dashcalib_ros'), 'config',
                                     'calibrator.yaml']),
     'the parameter file; what one camera has alone is below /NAME/calibrator in it'),
)
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
    value = {name: LaunchConfiguration(name) for name, _, _ in ARGUMENTS}
    return [
        Node(
            package='dashcalib_ros', executable='calibrator', name='calibrator', namespace=name,
            output='screen', respawn=True, respawn_delay=2.0, respawn_max_retries=5,
            parameters=[value['config'], {
                # its calibration has a file of this name
                'camera_name': name, 'image_transport': value['image_transport'],
                'use_sim_time': value['use_sim_time']}],
            remappings=[('image_raw', topic),
                        ('camera_info', topic.rpartition('/')[0] + '/camera_info')])
        for name, topic in cameras_in(value['cameras'].perform(context)).items()]


def generate_launch_description():
    """Start one calibrator for each camera, in the camera's namespace."""
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=default, description=about)
          for name, default, about in ARGUMENTS),
        OpaqueFunction(function=calibrators)])
