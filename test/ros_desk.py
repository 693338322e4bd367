# SPDX-License-Identifier: Apache-2.0
"""The real node in the tests' own process, between real publishers."""
from __future__ import annotations

import dataclasses
import gc

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from ros_bench import START, Bench, image_message
from std_srvs.srv import Trigger

from dashcalib_ros.camera import Radial
from dashcalib_ros.config import Config
from dashcalib_ros.errors import Notice
from dashcalib_ros.judge import Verdict
from dashcalib_ros.report import Calibration
from dashcalib_ros.ros import drive as drive_module
from dashcalib_ros.ros.background import Result
from dashcalib_ros.ros.node import CameraNode
from dashcalib_ros.ros.parameters import given_parameters

# s; the tests wait for the diagnostics again and again
drive_module.PERIOD_S = 0.1

FIRST = Radial((320, 240), 400.0, 401.0, 320.0, 180.0, -0.3, 0.1)
SIGMA = {'fx': 2.0, 'fy': 2.0, 'cx': 2.0, 'cy': 2.0, 'k1': 0.01, 'k2': 0.01}
STAMPS = iter(range(START, START + 10**12, 10**8))


class Desk:
    """The node and a bench, spun in turns."""

    def __init__(self, context, home, topic='image_raw', remapped='', program='calibrator',
                 **parameters):
        """topic: of the images. remapped: where the node's set_camera_info is, if it is."""
        arguments = ['--ros-args', '-p', f'camera_info_url:={home}/camera.yaml']
        if topic != 'image_raw':
            arguments += ['-r', f'image_raw:={topic}']
        if remapped:
            arguments += ['-r', f'set_camera_info:={remapped}']
        if 'image_transport' not in parameters:
            # node and bench take turns: the usual five would overflow where a turn is late
            arguments += ['-p', f'qos_overrides./{topic}.subscription.depth:=50']
        for name, value in parameters.items():
            arguments += ['-p', f'{name}:={value}']
        rclpy.init(args=[program, *arguments])
        self.file, self.closed = home / 'camera.yaml', False
        self.program = program
        try:
            self.node = CameraNode(program, given_parameters(program))
            self.node.start()
        except BaseException:
            rclpy.try_shutdown()
            raise
        self.spinner = SingleThreadedExecutor()
        self.spinner.add_node(self.node)
        self.bench = Bench(context, topic=topic)
        try:
            self.until(lambda: self.bench.heard() and self.matched())
            self.show()
        except BaseException:
            # the tests after this one have a node of their own
            self.close()
            raise

    @property
    def role(self):
        return self.node.role

    @property
    def drive(self):
        return self.node.role.drive

    def matched(self):
        """Return whether what the node publishes beside images is heard: nothing of it is lost."""
        return all(each.get_subscription_count() for each in self.node.publishers
                   if each.topic_name == self.node.resolve_topic_name('camera_info'))

    def until(self, condition):
        def spun():
            self.spinner.spin_once(timeout_sec=0.01)
            return condition()
        return self.bench.until(spun)

    def give(self, level='accepted', complete=True, sigma=SIGMA, warnings=(), turns=(),
             mount=None, drift=None, temperature_c=None, **changes):
        """Let the learner's thread come up with a calibration."""
        camera = dataclasses.replace(FIRST, **changes) if level != 'refused' else None
        calibration = Calibration(
            Verdict(level, () if level == 'accepted' else (Notice('', 'few turns'),)),
            (320, 240), camera, sigma if camera else None, turns, 10, 0.3, {}, {}, Config(),
            warnings=warnings, mount=mount, drift=drift, temperature_c=temperature_c)
        result = Result(calibration, complete, self.drive.learner.bank)
        done = []
        self.drive._later(lambda: self.drive.on_result(result))
        self.drive._later(lambda: done.append(True))
        self.until(lambda: done)

    def show(self):
        """Publish an image; return the fx of its camera_info, None if there is none."""
        before, received = len(self.bench.infos), self.bench.count('received')
        message = image_message(black(), next(STAMPS))
        self.bench.images.publish(message)
        # diagnostics may overtake it
        self.until(lambda: self.bench.count('received') > received
                   and len(self.bench.infos) >= self.bench.count('camera_info published'))
        infos = self.bench.infos[before:]
        return infos[0].k[0] if infos else None

    def call(self, name):
        """Call a service of the node."""
        client = self.bench.node.create_client(Trigger, f'{self.program}/{name}')
        self.until(client.service_is_ready)
        future = client.call_async(Trigger.Request())
        self.until(future.done)
        self.bench.node.destroy_client(client)
        return future.result()

    def close(self):
        """Close all; closing it again does nothing."""
        if not self.closed:
            self.closed = True
            self.bench.close()
            self.spinner.shutdown()
            self.node.close()
            rclpy.try_shutdown()
            # rclpy keeps a lifecycle node in the graph until it is collected
            self.node = self.spinner = None
            gc.collect()


def black():
    return np.zeros((240, 320), np.uint8)
