# SPDX-License-Identifier: Apache-2.0
"""The output folder and its report.html; comparisons; what a terminal shows: tables.py."""
from dashcalib_ros.judge import Verdict
from dashcalib_ros.judge.difference import NamedCamera
from dashcalib_ros.report.calibration import AcceptedCalibration, Calibration
from dashcalib_ros.report.compare import answer_dict, compare
from dashcalib_ros.report.files import (
    Written,
    check_writable,
    output_folder,
    set_aside,
    write_results,
    write_text,
)
from dashcalib_ros.report.page import report_html

__all__ = ['AcceptedCalibration', 'Calibration', 'NamedCamera', 'Verdict', 'Written',
           'answer_dict', 'check_writable', 'compare', 'output_folder', 'report_html', 'set_aside',
           'write_results', 'write_text']
