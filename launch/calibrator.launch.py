"""ros2 launch dashcalib_ros calibrator.launch.py [namespace:=front] [image:=image_raw] ..."""
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

ARGUMENTS = (
    ('program', 'calibrator', 'calibrator, or checker for the calibration of a driver'),
    ('namespace', '', 'the namespace of the camera, which also gives it its name'),
    ('image', 'image_raw', 'the image topic, without /compressed'),
    ('camera_info', 'camera_info', 'the topic on which the calibration is published'),
    ('image_transport', 'raw', 'raw, compressed or video; overrides the parameter file'),
    ('use_sim_time', 'false', 'true for a bag played with --clock; overrides the parameter file'),
    ('config', PathJoinSubstitution([FindPackageShare('dashcalib_ros'), 'config',
                                     'calibrator.yaml']), 'the parameter file'),
    ('rviz', 'false', 'true starts RViz with the images, the overlay and the rectified picture'),
)
RVIZ = PathJoinSubstitution([FindPackageShare('dashcalib_ros'), 'config', 'dashcalib.rviz'])
# topics in RVIZ that are in the namespace
PICTURES = ('calibrator/overlay/compressed', 'calibrator/rectified/compressed')


def generate_launch_description():
    """Start one node, which configures and activates itself; include this for each camera."""
    value = {name: LaunchConfiguration(name) for name, _, _ in ARGUMENTS}
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=default, description=about)
          for name, default, about in ARGUMENTS),
        Node(
            package='dashcalib_ros', executable=value['program'], name=value['program'],
            namespace=value['namespace'], output='screen',
            # a wrong parameter ends it each time
            respawn=True, respawn_delay=2.0, respawn_max_retries=5,
            parameters=[value['config'], {'image_transport': value['image_transport'],
                                          'use_sim_time': value['use_sim_time']}],
            remappings=[('image_raw', value['image']), ('camera_info', value['camera_info'])]),
        Node(
            package='rviz2', executable='rviz2', name='rviz', namespace=value['namespace'],
            arguments=['-d', RVIZ], condition=IfCondition(value['rviz']),
            remappings=[('/image_raw', value['image']),
                        *((f'/{topic}', topic) for topic in PICTURES)]),
    ])
