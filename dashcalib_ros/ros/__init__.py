# SPDX-License-Identifier: Apache-2.0
"""The ROS 2 nodes; the only room that imports rclpy, and only when a node is started."""
from __future__ import annotations

import signal
import sys
from collections.abc import Sequence

from dashcalib_ros.errors import ConfigError, DashcalibError, coded
from dashcalib_ros.ros.interface import CALIBRATOR, CHECKER, RIG
from dashcalib_ros.standard_streams import open_closed_streams, write_stderr, write_stdout
from dashcalib_ros.workers.worker import prepare_process

INSTALL = ("the Python package {name} is missing: source your ROS 2 installation "
           "(. /opt/ros/jazzy/setup.sh), or pip install '.[ros]' (Jazzy) or '.[ros-kilted]' in "
           "the sources")
ROS_PACKAGES = ('rclpy', 'builtin_interfaces', 'diagnostic_msgs', 'geometry_msgs',
                'lifecycle_msgs', 'nav_msgs', 'rcl_interfaces', 'sensor_msgs', 'std_msgs',
                'std_srvs')
# SIGHUP: the terminal was closed, or its connection lost
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def calibrator() -> int:
    """Run the program calibrator."""
    return main(CALIBRATOR)


def checker() -> int:
    """Run the program checker."""
    return main(CHECKER)


def rig() -> int:
    """Run the program rig."""
    return main(RIG)


def main(program: str, argv: Sequence[str] | None = None) -> int:
    """Run a program until it is stopped; return its exit code. argv: without its name."""
    # the handlers come first: Ctrl-C may be pressed while the imports still run, and again
    signals: list[int] = []
    for each in SIGNALS:
        # nohup: the node outlives its terminal
        if each != signal.SIGHUP or signal.getsignal(each) is not signal.SIG_IGN:
            signal.signal(each, lambda number, frame: signals.append(number))
    open_closed_streams()
    prepare_process()
    try:
        from dashcalib_ros.ros.settings import check_files, help_text, parse
        arguments = list(sys.argv[1:] if argv is None else argv)
        wants_help, required = parse(arguments)
        if wants_help:
            write_stdout(help_text(program))
            return 0
        check_files(arguments)
        from dashcalib_ros.ros.program import run
        return run(program, arguments, required, lambda: bool(signals))
    except DashcalibError as error:
        return _fail(program, error)
    except ModuleNotFoundError as error:
        missing = (error.name or '').partition('.')[0]
        if missing not in ROS_PACKAGES:
            raise
        return _fail(program, ConfigError(
            'E-ROS-NOT-INSTALLED', INSTALL.format(name=missing)))
    finally:
        # while the interpreter ends, they would kill it
        for each in SIGNALS:
            signal.signal(each, signal.SIG_IGN)


def _fail(program: str, error: DashcalibError) -> int:
    write_stderr(f'{program}: error: {coded(error)}')
    return 2
