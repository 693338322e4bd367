"""Where a calibration's file is: camera_info_manager's URLs, and plain paths."""
from __future__ import annotations

import os
import re
from pathlib import Path
from urllib.parse import urlsplit

from dashcalib_ros.errors import InputError

# camera_info_manager's
DEFAULT = 'file://${ROS_HOME}/camera_info/${NAME}.yaml'
KNOWN = 'file:///folder/camera.yaml, package://package/folder/camera.yaml, or a path'


def camera_info_path(url: str, camera_name: str) -> Path:
    """Return the file of a URL or path; empty: camera_info_manager's own place.

    ${ROS_HOME} is $ROS_HOME, or ~/.ros; ${NAME} the camera's name; ~ the home folder. Raises
    InputError for other schemes and variables, for a package that is not installed, and for the
    home folder of an unknown user.
    """
    text = re.sub(r'\$\{(.*?)\}', lambda found: _value(found[1], camera_name), url or DEFAULT)
    scheme = text.partition('://')[0].lower() if '://' in text else ''
    if scheme == 'package':
        return _in_package(text)
    if scheme not in ('', 'file'):
        raise InputError(f'camera_info_url {url}: nothing can be kept at {scheme}://; use {KNOWN}')
    path = text[len('file://'):] if scheme else text
    if scheme and not path.startswith(('/', '~')):
        raise InputError(f'camera_info_url {url}: file:// needs a path that begins with /, as in '
                         f'file:///folder/camera.yaml')
    if not path or path.endswith('/'):
        raise InputError(f'camera_info_url {url} names no file; use {KNOWN}')
    try:
        return Path(path).expanduser()
    except RuntimeError as error:  # the user, or the own home folder, is unknown
        raise InputError(f'there is no home folder for {path}; set camera_info_url to a path '
                         f'without ~') from error


def _value(name: str, camera_name: str) -> str:
    if name == 'NAME':
        return camera_name
    if name == 'ROS_HOME':
        return os.environ.get('ROS_HOME') or '~/.ros'
    raise InputError(f'camera_info_url: there is no ${{{name}}}; there are ${{ROS_HOME}} and '
                     f'${{NAME}}')


def _in_package(url: str) -> Path:
    from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
    parts = urlsplit(url)
    rest = parts.path.strip('/')
    if not parts.netloc or not rest:
        raise InputError(f'camera_info_url {url} names no file in a package; use {KNOWN}')
    try:
        share = get_package_share_directory(parts.netloc)
    except (PackageNotFoundError, ValueError, OSError) as error:
        raise InputError(f'camera_info_url {url}: there is no package {parts.netloc}; source its '
                         f'workspace, or use file://') from error
    return Path(share, rest)
