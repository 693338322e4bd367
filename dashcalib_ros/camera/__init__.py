"""The camera models: projection, viewing rays, derivatives, limits; COLMAP's names and ROS's."""
from dashcalib_ros.camera.camera import Camera, ros_camera
from dashcalib_ros.camera.equidistant import Fisheye
from dashcalib_ros.camera.models import (
    AUTO,
    MODELS,
    camera_from_ros,
    camera_of,
    model_named,
    searched,
)
from dashcalib_ros.camera.plumb_bob import Brown, Radial

__all__ = ['AUTO', 'MODELS', 'Brown', 'Camera', 'Fisheye', 'Radial', 'camera_from_ros', 'camera_of',
           'model_named', 'ros_camera', 'searched']
