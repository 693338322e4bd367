# SPDX-License-Identifier: Apache-2.0
"""The tests' side of the wire: the node as a process of its own, and a camera that it hears."""
from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from importlib import metadata
from pathlib import Path

import cv2
import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from processes import processes_of
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

REPOSITORY = Path(__file__).resolve().parent.parent
DOMAIN = 1 + os.getpid() % 100
# s; how long anything may take that should come at once: machines are slow, DDS discovery too
SOON = 30.0
# s; an answer that did not come by then is lost
LOST_S = 5.0
SECOND = 10**9
# ns; stamp of the first image
START = 1_767_614_400 * SECOND
COMMAND = [sys.executable, '-m', 'dashcalib_ros.ros']
# the same with diagnostics ten times a second, which tests wait for again and again, with a queue
# that a machine busy with other tests does not overrun, and without loading at the start what few
# of them need
QUICK_COMMAND = [sys.executable, '-c', """
import sys
from dashcalib_ros import pipeline
from dataclasses import replace
from dashcalib_ros.ros import drive, interface, main
interface.SUBSCRIBED['image_raw'] = replace(interface.SUBSCRIBED['image_raw'], depth=50)
drive.PERIOD_S = 0.1
pipeline._load_judging = lambda: None
named = sys.argv[1] in interface.PROGRAMS
sys.exit(main(sys.argv[1] if named else 'calibrator', sys.argv[1 + named:]))
"""]


def profiles(path):
    """Return what lets Fast DDS read a file; Kilted's rclpy is 9, and warns of the older name."""
    kilted = int(metadata.version('rclpy').partition('.')[0]) >= 9
    return {f'{"FASTDDS" if kilted else "FASTRTPS"}_DEFAULT_PROFILES_FILE': str(path)}


# for a driver's process
LARGE_IMAGES = profiles(REPOSITORY / 'config' / 'fastdds_large_images.xml')


def ros_environment(home):
    """Return what keeps a process on this machine, in this run, and strict."""
    return {
        'ROS_DOMAIN_ID': str(DOMAIN), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'ROS_PYTHON_CHECK_FIELDS': '1', 'FASTDDS_BUILTIN_TRANSPORTS': 'UDPv4',
        **profiles(REPOSITORY / 'testing' / 'fastdds_one_process.xml'),
        'HOME': str(home), 'ROS_LOG_DIR': str(Path(home) / 'log'),
        'PYTHONPATH': os.pathsep.join([str(REPOSITORY), os.environ.get('PYTHONPATH', '')])}


def pairs(parameters):
    """Return parameters as ROS's arguments; a__b is for a.b."""
    return [part for name, value in parameters.items()
            for part in ('-p', f'{name.replace("__", ".")}:={_yaml(value)}')]


class NodeProcess:
    """The node, started as a user would; its output goes to a file."""

    def __init__(self, home, *arguments, command=COMMAND, python_path=None, **parameters):
        self.home = Path(home)
        self.output = self.home / f'node-{time.monotonic_ns()}.log'
        with self.output.open('wb') as stream:
            self.process = subprocess.Popen(
                [*command, '--ros-args', *pairs(parameters), *arguments], stdout=stream,
                stderr=subprocess.STDOUT,
                env={**os.environ, **ros_environment(home),
                     **({'PYTHONPATH': python_path} if python_path else {})},
                start_new_session=True)

    @property
    def text(self):
        return self.output.read_text()

    def wait_for(self, words, limit=SOON):
        """Wait until the log has these words."""
        end = time.monotonic() + limit
        while words not in self.text:
            assert self.process.poll() is None, self.text
            assert time.monotonic() < end, f'no {words!r} in\n{self.text}'
            time.sleep(0.05)

    def catches(self, number):
        """Tell whether the process handles this signal itself."""
        status = Path(f'/proc/{self.process.pid}/status').read_text()
        mask = int(status.partition('SigCgt:')[2].split()[0], 16)
        return bool(mask >> (number - 1) & 1)

    def children(self):
        """Return the ids of the living processes that the node started."""
        return [pid for pid in processes_of(self.process.pid) if pid != self.process.pid]

    def stop(self, *signals, limit=SOON):
        """Send the signals, wait for the end and return the exit code."""
        for each in signals or (signal.SIGINT,):
            self.process.send_signal(each)
        return self.process.wait(limit)

    def kill(self):
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait(SOON)


class Bench:
    """A camera and a listener in one node; nothing waits without a limit."""

    def __init__(self, context, namespace='', image_type=Image, topic='image_raw',
                 reliable=True, listen=True, name='bench'):
        self.node = rclpy.create_node(name, context=context, namespace=namespace)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.node)
        kind = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        self.kind, self.reliability = kind, kind.name.lower()
        self.images = self.node.create_publisher(
            image_type, topic, QoSProfile(depth=50, reliability=kind))
        self.infos, self.latched, self.status, self.magnitudes = [], [], None, []
        if listen:
            latched = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                                 durability=DurabilityPolicy.TRANSIENT_LOCAL)
            for kind, name, call, profile in (
                    (CameraInfo, 'camera_info', self.on_info, 1000),
                    (CameraInfo, 'calibrator/calibration', self.latched.append, latched),
                    (DiagnosticArray, '/diagnostics', self._on_diagnostics, 10),
                    (Float64, 'calibrator/turn_magnitude', self.magnitudes.append, 100)):
                self.node.create_subscription(kind, name, call, profile)

    def on_info(self, message):
        self.infos.append(message)

    def _on_diagnostics(self, message):
        self.status = message.status[0]

    @property
    def values(self):
        """Return the diagnostics' values by name, of the newest message."""
        return {pair.key: pair.value for pair in self.status.values} if self.status else {}

    def until(self, condition, limit=SOON, what='what was waited for', node=None):
        """Spin until the condition holds and return it."""
        end = time.monotonic() + limit
        while not (held := condition()):
            dead = node is not None and node.process.poll() is not None
            assert not dead and time.monotonic() < end, (
                f'{what} did not come; diagnostics: {self.values}\n{node.text if node else ""}')
            self.executor.spin_once(timeout_sec=0.02)
        return held

    def spin(self, seconds):
        """Spin for a while."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.02)

    def heard(self):
        """Return whether the node hears the images, as reliably as they come, and is heard."""
        others = self.node.get_subscriptions_info_by_topic(self.images.topic_name)
        return (self.images.get_subscription_count() == len(others) > 0
                and all(each.qos_profile.reliability == self.kind for each in others)
                and self.values.get('reliability') == self.reliability)

    def connect(self, node):
        """Wait until the node hears the images, and is heard."""
        self.until(self.heard, what='the connection', node=node)
        # the other side matches a moment later
        self.spin(0.2)

    def publish(self, *messages):
        for message in messages:
            self.images.publish(message)
            # a camera has a rate; a burst would overrun the subscription's queue
            self.spin(0.01)

    def count(self, key):
        return int(self.values.get(key, -1))

    def counted(self, key, at_least, node):
        """Wait until diagnostics have counted so many."""
        self.until(lambda: self.count(key) >= at_least, what=f'{key} >= {at_least}', node=node)

    def call(self, name, node, kind=Trigger, limit=SOON):
        """Call one of the node's services and return the answer; limit: s that it may take.

        A service that does not know the client's reader yet loses its answer, and says so
        (rmw_fastrtps issue 842): only then it is asked again.
        """
        client = self.node.create_client(kind, f'calibrator/{name}')
        self.until(client.service_is_ready, what=f'the service {name}', node=node)
        futures, began = [], time.monotonic()

        def answer():
            late = time.monotonic() > began + LOST_S * len(futures)
            if not futures or (late and 'failed to send response' in node.text):
                futures.append(client.call_async(kind.Request()))
            return next((future for future in futures if future.done()), None)

        future = self.until(answer, limit, f'the answer of {name}', node)
        self.node.destroy_client(client)
        return future.result()

    def close(self):
        self.executor.shutdown()
        self.node.destroy_node()


def image_message(picture, stamp_ns, frame_id='camera', encoding=None):
    """Return a sensor_msgs/Image; (h, w) is mono8, (h, w, 3) bgr8."""
    picture = np.ascontiguousarray(picture)
    message = Image(height=picture.shape[0], width=picture.shape[1],
                    encoding=encoding or ('mono8' if picture.ndim == 2 else 'bgr8'),
                    step=picture.strides[0])
    message.data.frombytes(picture.tobytes())
    return _stamped(message, stamp_ns, frame_id)


def compressed_message(picture, stamp_ns, frame_id='camera', suffix='.jpg'):
    """Return a sensor_msgs/CompressedImage."""
    message = CompressedImage(format='jpeg' if suffix == '.jpg' else suffix[1:])
    message.data.frombytes(cv2.imencode(suffix, picture)[1].tobytes())
    return _stamped(message, stamp_ns, frame_id)


def noise(index, size=(320, 240)):
    """Return a picture without meaning."""
    return np.random.default_rng(index).integers(0, 256, size[::-1], np.uint8)


def stream(bench, count, first=0, make=image_message, size=(320, 240), **options):
    """Publish images without meaning at 10 Hz of their own time, faster than that."""
    for index in range(first, first + count):
        bench.publish(make(noise(index, size), START + index * SECOND // 10, **options))


CAMERA_FILE = """\
image_width: {width}
image_height: 240
camera_name: dashcam
camera_matrix: {{rows: 3, cols: 3, data: [200.0, 0.0, 160.0, 0.0, 201.0, 120.0, 0.0, 0.0, 1.0]}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: [-0.1, 0.01, 0.0, 0.0, 0.0]}}
"""
OURS = """\
dashcalib:
  verdict: accepted
  sigma: {fx: 1.0, fy: 1.0, cx: 1.0, cy: 1.0, k1: 0.01, k2: 0.01}
  frame_id: camera
"""


def keep_file(home, text, name='dashcam'):
    """Leave a calibration where the node looks for it."""
    path = home / '.ros' / 'camera_info' / f'{name}.yaml'
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text.replace('camera_name: dashcam', f'camera_name: {name}'))
    return path


def _stamped(message, stamp_ns, frame_id):
    message.header.frame_id = frame_id
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
    return message


def _yaml(value):
    if isinstance(value, bool):
        return str(value).lower()
    return repr(value) if isinstance(value, (int, float)) else str(value)
