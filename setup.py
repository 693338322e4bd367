# SPDX-License-Identifier: Apache-2.0
from glob import glob
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

PACKAGE = 'dashcalib_ros'
ROOT = Path(__file__).parent
# ROS's tools read package.xml: version, addresses and maintainer stand there and nowhere else
ABOUT = ElementTree.parse(ROOT / 'package.xml')
MAINTAINER = ABOUT.find('maintainer')

setup(
    name=PACKAGE,
    version=ABOUT.findtext('version'),
    description='Calibrates a dashcam from the turns the car takes anyway',
    long_description=(ROOT / 'README.md').read_text('utf-8'),
    long_description_content_type='text/markdown',
    keywords=['camera calibration', 'dashcam', 'ROS 2', 'structure from motion'],
    classifiers=[
        'Development Status :: 4 - Beta',
        'Intended Audience :: Developers',
        'Intended Audience :: Science/Research',
        'Operating System :: POSIX :: Linux',
        'Programming Language :: Python :: 3',
        *(f'Programming Language :: Python :: 3.{minor}' for minor in range(10, 15)),
        'Topic :: Scientific/Engineering :: Image Processing',
        'Typing :: Typed',
    ],
    maintainer=MAINTAINER.text,
    maintainer_email=MAINTAINER.get('email'),
    project_urls={url.get('type').capitalize(): url.text for url in ABOUT.findall('url')},
    license='Apache-2.0',
    packages=find_packages(include=[PACKAGE, f'{PACKAGE}.*']),
    package_data={PACKAGE: ['py.typed', 'report/templates/*']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
        (f'share/{PACKAGE}', ['package.xml']),
        (f'share/{PACKAGE}/config', glob('config/*')),
        (f'share/{PACKAGE}/launch', glob('launch/*.launch.*')),
        # where ros2 run and launch look, whoever installs it
        (f'lib/{PACKAGE}', glob('scripts/*')),
    ],
    zip_safe=True,
    python_requires='>=3.10',
    install_requires=[
        'setuptools',
        'numpy>=1.26',
        'scipy>=1.11',
        'opencv-python-headless>=4.10',
        # estimates poses; OpenCV does where it has no wheels
        'pycolmap>=4.2; platform_machine == "x86_64" or platform_machine == "AMD64" '
        'or (platform_machine == "arm64" and sys_platform == "darwin")',
        'rosbags>=0.11.9',
        'apsw',
        'mcap>=1.2',
        # of Foxglove's messages: a wheel of 0.3 MB without dependencies
        'protobuf>=4.22',
        'backports.zstd>=1; python_version < "3.14"',
        'lz4>=4',
        'PyYAML>=6',
        'av>=17',
        'rich>=13',
        'jinja2>=3.0',
    ],
    extras_require={
        # one of the two: both have the same packages
        'ros': ['ros-jazzy-rclpy[fastrtps]', 'ros-jazzy-common-interfaces'],
        'ros-kilted': ['ros-kilted-rclpy[fastrtps]', 'ros-kilted-common-interfaces'],
        'completion': ['argcomplete>=3'],
        'segmentation': ['onnxruntime>=1.17'],
        # its wheels end at Python 3.12
        'motion': ['telemetry-parser>=0.3; python_version < "3.13"'],
        'fleet': ['ray[client]>=2.40', 'pyarrow>=15', 'fsspec>=2024.2'],
        'test': ['pytest>=8', 'pytest-xdist>=3', 'hypothesis>=6', 'ruff', 'mypy', 'types-PyYAML',
                 'onnxruntime>=1.17', 'onnx>=1.16', 'argcomplete>=3', 'wheel', 'nbclient>=0.10',
                 'ipykernel>=6', 'matplotlib>=3.8', 'ray>=2.40', 'pyarrow>=15',
                 'fsspec>=2024.2', 'twine>=5'],
        'docs': ['mkdocs-material>=9.5', 'mkdocstrings[python]>=0.26', 'mike>=2.1',
                 'latex2mathml>=3.77'],
        'benchmark': ['matplotlib>=3.8'],
    },
    entry_points={
        'console_scripts': [
            'dashcalib = dashcalib_ros.cli:command',
            'dashcalib-calibrator = dashcalib_ros.ros:calibrator',
            'dashcalib-checker = dashcalib_ros.ros:checker',
            'dashcalib-rig = dashcalib_ros.ros:rig',
        ],
    },
)
