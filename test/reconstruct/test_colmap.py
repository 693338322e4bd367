"""What COLMAP and Ceres say goes to stderr only."""
from __future__ import annotations

import os
import subprocess
import sys

PROGRAM = """
from dashcalib_ros.reconstruct.colmap import pyceres, pycolmap

class Endless(pyceres.CostFunction):
    def __init__(self):
        super().__init__()
        self.set_num_residuals(1)
        self.set_parameter_block_sizes([1])

    def Evaluate(self, parameters, residuals, jacobians):
        residuals[0] = 1e300
        return True

pycolmap.logging.warning('said by COLMAP')
value, problem = __import__('numpy').zeros(1), pyceres.Problem()
problem.add_residual_block(Endless(), None, [value])
pyceres.solve(pyceres.SolverOptions(), problem, pyceres.SolverSummary())
"""


def test_no_log_is_left_in_the_scratch_folder(tmp_path):
    done = subprocess.run([sys.executable, '-c', PROGRAM], capture_output=True, text=True,
                          timeout=60, env={**os.environ, 'TMPDIR': str(tmp_path)}, check=True)
    assert 'said by COLMAP' in done.stderr and 'minimizer' in done.stderr
    assert list(tmp_path.iterdir()) == []
