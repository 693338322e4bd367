from glob import glob

from setuptools import find_packages, setup

PACKAGE = 'dashcalib_ros'

setup(
    name=PACKAGE,
    version='0.1.0',
    description='Calibrates a dashcam from the turns the car takes anyway',
    maintainer='dashcalib_ros maintainers',
    maintainer_email='maintainers@example.com',
    license='Apache-2.0',
    packages=find_packages(include=[PACKAGE, f'{PACKAGE}.*']),
    package_data={PACKAGE: ['py.typed']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
        (f'share/{PACKAGE}', ['package.xml']),
        (f'share/{PACKAGE}/config', glob('config/*')),
        (f'share/{PACKAGE}/launch', glob('launch/*.launch.*')),
    ],
    zip_safe=True,
    python_requires='>=3.10',
    install_requires=[
        'setuptools',
        'numpy>=1.26',
        'scipy>=1.11',
        'opencv-python-headless>=4.10',
        'pycolmap>=4.2',
        'pyceres>=2.6',
        'rosbags>=0.11',
        'mcap>=1.2',
        'zstandard>=0.22',
        'lz4>=4',
        'PyYAML>=6',
        'rich>=13',
    ],
    extras_require={
        'ros': ['ros-jazzy-rclpy[fastrtps]', 'ros-jazzy-common-interfaces'],
        'segmentation': ['onnxruntime>=1.17'],
        'test': ['pytest>=8', 'pytest-xdist>=3', 'hypothesis>=6', 'ruff', 'mypy', 'types-PyYAML',
                 'onnxruntime>=1.17', 'onnx>=1.16'],
        'benchmark': ['matplotlib>=3.8'],
    },
    entry_points={
        'console_scripts': [
            'dashcalib = dashcalib_ros.cli:main',
            'calibrator = dashcalib_ros.ros:main',
        ],
    },
)
