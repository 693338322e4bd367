"""calibration.yaml, result.json, report.html; comparisons; what a terminal shows: tables.py."""
from dashcalib_ros.judge import AcceptedCalibration, Calibration, Verdict
from dashcalib_ros.judge.difference import NamedCamera
from dashcalib_ros.report.camera_file import calibrated_camera, load_camera
from dashcalib_ros.report.compare import compare
from dashcalib_ros.report.files import (
    Written,
    check_writable,
    output_folder,
    save,
    set_aside,
    write_results,
    write_text,
)
from dashcalib_ros.report.page import report_html
from dashcalib_ros.report.result import (
    answer_dict,
    calibration_yaml,
    load_calibration,
    result_dict,
    result_json,
)

__all__ = ['AcceptedCalibration', 'Calibration', 'NamedCamera', 'Verdict', 'Written',
           'answer_dict', 'calibrated_camera', 'calibration_yaml', 'check_writable', 'compare',
           'load_calibration', 'load_camera', 'output_folder', 'report_html', 'result_dict',
           'result_json', 'set_aside', 'write_results', 'write_text']

# a result's files are written and read here: judge/, which makes the result, knows no files
for _name, _function in (('load', staticmethod(load_calibration)), ('save', save)):
    setattr(Calibration, _name, _function)
