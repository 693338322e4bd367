"""From the command line to a spinning node and back to an exit code."""
from __future__ import annotations

import sys
from collections.abc import Sequence

import rclpy
import rclpy.utilities
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException

from dashcalib_ros.errors import DashcalibError
from dashcalib_ros.ros.memory import give_images_back
from dashcalib_ros.ros.node import CalibratorNode
from dashcalib_ros.ros.stopping import Stopping

FAILED = 2


def run(argv: Sequence[str] | None, stopping: Stopping) -> int:
    """Run the node: 0 when it was asked to stop, 2 when its parameters are wrong."""
    node: CalibratorNode | None = None
    give_images_back()
    try:
        # rclpy takes the program's name for the first argument
        rclpy.init(args=None if argv is None else ['calibrator', *argv])
        if not stopping.requested:
            node = CalibratorNode()
            rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (DashcalibError, ParameterException) as error:
        print(f'calibrator: error: {" ".join(str(error).split())}', file=sys.stderr)
        return FAILED
    except Exception:
        # a context that is shut down in the middle of a call makes rclpy raise nearly anything
        if not stopping.requested:
            raise
    finally:
        if node is not None:
            node.close()
        rclpy.utilities.try_shutdown()
    return 0
