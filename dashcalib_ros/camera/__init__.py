"""The camera models: projection, viewing rays, derivatives, limits; COLMAP's names and ROS's."""
from dashcalib_ros.camera.camera import Camera, ros_camera
from dashcalib_ros.camera.models import MODELS, camera_from_ros, camera_of, model_named
from dashcalib_ros.camera.plumb_bob import Brown, Radial

__all__ = ['MODELS', 'Brown', 'Camera', 'Radial', 'camera_from_ros', 'camera_of', 'model_named',
           'ros_camera']
