# SPDX-License-Identifier: Apache-2.0
"""What holds for all tests; fixtures of those that talk to the node, which import rclpy late."""
import os
import signal
import sys
from pathlib import Path

import pytest

# as in a worker's process, before numpy is loaded: more threads change the last digits, and where
# several tests run at a time they mostly wait for each other
for name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
    os.environ.setdefault(name, '1')
# as in a program of ours, whose stderr has no lines of OpenCV
os.environ.setdefault('OPENCV_LOG_LEVEL', 'SILENT')

# the tests start some hundred processes. Where Python may write no compiled files beside the
# sources, each would compile all that it imports, for seconds: they share a folder
if sys.dont_write_bytecode:
    sys.dont_write_bytecode = False
    sys.pycache_prefix = str(Path(__file__).parents[1] / '.pytest_cache' / 'compiled')
    os.environ['PYTHONPYCACHEPREFIX'] = sys.pycache_prefix
    os.environ.pop('PYTHONDONTWRITEBYTECODE', None)

pytest.register_assert_rewrite('ros_bench', 'ros_desk')


def pytest_configure(config):
    """Let Ctrl-C be heard where the tests run behind a shell's `&` or nohup, which ignore it.

    A program that is started with SIGINT ignored leaves it so, and hands that on.
    """
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


# the files that take longest, the longest first: begun last, each would keep one core alone
LONG_FILES = ('test_node.py', 'test_pipeline.py', 'test_solve.py', 'test_drive.py',
              'test_style.py', 'test_run.py', 'test_docs_commands.py', 'test_witnesses.py',
              'test_example.py', 'test_around.py', 'test_packaging.py', 'test_fuse.py',
              'test_rig.py', 'test_batch.py', 'test_fixed_camera.py', 'test_session.py',
              'test_choice.py', 'test_child.py', 'test_lifecycle.py', 'test_field.py',
              'test_shutter.py', 'test_drift.py', 'test_known.py', 'test_one_camera.py',
              'test_judging.py', 'test_earlier.py', 'test_causes.py', 'test_pool.py',
              'test_install.py', 'test_segmentation.py', 'test_play.py', 'test_usage.py',
              'test_learner.py', 'test_odd_bags.py', 'test_lens_prior.py', 'test_export.py')


def pytest_collection_modifyitems(items):
    """Put the long files first; each file's tests stay in their order."""
    ranks = {name: rank for rank, name in enumerate(LONG_FILES)}
    items.sort(key=lambda item: ranks.get(item.path.name, len(ranks)))


@pytest.fixture(scope='session')
def shared_drive(tmp_path_factory):
    """A drive with two turns; the workers of a run share its pictures."""
    from shared_drive import SharedDrive
    folder = tmp_path_factory.getbasetemp()
    if 'PYTEST_XDIST_WORKER' in os.environ:
        folder = folder.parent
    return SharedDrive(folder / 'shared_drive.npy')


@pytest.fixture(scope='session')
def shared_calibration(shared_drive):
    """What comes of the shared drive with QUICK; it is calibrated once in a run."""
    from shared_drive import shared_calibration
    return shared_calibration(shared_drive)


@pytest.fixture(scope='module')
def ros_context(tmp_path_factory):
    """rclpy in the tests' own process, in this run's own domain."""
    rclpy = pytest.importorskip('rclpy')
    from ros_bench import ros_environment
    before = dict(os.environ)
    os.environ.update(ros_environment(tmp_path_factory.mktemp('home')))
    context = rclpy.Context()
    rclpy.init(context=context)
    yield context
    rclpy.try_shutdown(context=context)
    os.environ.clear()
    os.environ.update(before)


@pytest.fixture
def start_node(tmp_path, ros_context):
    """Start nodes that are gone after the test, whatever happens."""
    from ros_bench import QUICK_COMMAND, NodeProcess
    nodes = []

    def start(*arguments, command=QUICK_COMMAND, **parameters):
        nodes.append(NodeProcess(tmp_path, *arguments, command=command, **parameters))
        return nodes[-1]

    yield start
    for node in nodes:
        node.kill()


@pytest.fixture
def make_bench(ros_context):
    """Make benches that are closed after the test."""
    from ros_bench import Bench
    made = []

    def make(**options):
        made.append(Bench(ros_context, **options))
        return made[-1]

    yield make
    for each in made:
        each.close()


@pytest.fixture
def make_desk(ros_context, tmp_path):
    """Make nodes in this process; they are closed after the test."""
    from ros_desk import Desk
    made = []

    def make(**parameters):
        made.append(Desk(ros_context, tmp_path, **parameters))
        return made[-1]

    yield make
    for each in made:
        each.close()


@pytest.fixture
def tf2(monkeypatch):
    """Stand in for tf2_msgs, which is not on the package index."""
    from types import SimpleNamespace

    from dashcalib_ros.ros import car
    monkeypatch.setitem(sys.modules, 'tf2_msgs', SimpleNamespace())
    monkeypatch.setitem(sys.modules, 'tf2_msgs.msg', SimpleNamespace(TFMessage=SimpleNamespace))
    monkeypatch.setattr(car, 'LISTEN_S', 0.0)
