"""What only the node needs to be told. No ROS is imported: the help is printed without it."""
from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from dashcalib_ros.config import _check, expert, setting
from dashcalib_ros.errors import ConfigError

# these take effect at once; all others are read-only while the node runs
CHANGEABLE = ('commit', 'publish_stale', 'turns.wanted')


@dataclass(frozen=True)
class NodeConfig:
    """The node's own settings. Raises ConfigError like Config."""

    image_transport: str = setting(
        'raw', 'compressed subscribes image_raw/compressed instead',
        choices=('raw', 'compressed'))
    reliability: str = setting(
        'auto', 'auto does as the publishers do: best effort if any of them does',
        choices=('auto', 'best_effort', 'reliable'))
    camera_name: str = setting(
        '', "in the file and its name; empty: the namespace of the images' topic, or dashcam")
    camera_info_url: str = setting(
        '', 'of the accepted calibration: a path, file:// or package://, with ${ROS_HOME} and '
            '${NAME}; empty: file://${ROS_HOME}/camera_info/${NAME}.yaml')
    camera_info_file: str = setting(
        '', 'older name of camera_info_url; set only one of them', expert=True)
    mask_file: str = setting(
        '', 'picture as large as the images, black where they are not used; empty: none')
    commit: bool = setting(
        False, 'give an accepted calibration to the camera driver: service set_camera_info')
    publish_stale: bool = setting(
        False, 'go on publishing a calibration that new turns contradict')
    check_only: bool = setting(
        False, 'only check the calibration that the driver publishes on camera_info; nothing is '
               'published there, saved or committed')
    queue_size: int = expert(
        10, 'images that may wait for detection, a second of them; the oldest is dropped', 1, 1000)
    preview_rate: float = expert(
        5.0, 'Hz; overlay and rectified picture at the most: people follow a drive at 5', 0.1,
        30.0)
    preview_quality: int = expert(
        80, 'of these pictures as JPEG; 95 takes twice the space', 10, 100)
    commit_timeout: float = expert(5.0, 's; how long the driver may take to answer', 0.1, 600.0)
    better: float = expert(
        0.7, "ratio; a new calibration replaces the old one when fx's sigma falls to this",
        0.1, 1.0)
    contradictions: int = expert(
        3, 'in a row, before the old calibration is given up: one or two may be chance', 1, 20)

    def __post_init__(self) -> None:
        for spec in dataclasses.fields(self):
            _check(spec.name, spec, getattr(self, spec.name))
        if self.camera_info_url and self.camera_info_file:
            raise ConfigError('camera_info_file is the older name of camera_info_url: set only '
                              'camera_info_url')
        if self.check_only and self.commit:
            raise ConfigError("commit changes the driver's calibration, which check_only only "
                              'checks: set one of them')

    @property
    def calibration_url(self) -> str:
        """Return the URL or path of the calibration's file; empty for the default."""
        return self.camera_info_url or self.camera_info_file
