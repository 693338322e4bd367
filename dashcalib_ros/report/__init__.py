"""calibration.yaml, result.json, report.html; comparisons; what a terminal shows: tables.py."""
from dashcalib_ros.camera.mapping import mapping_error
from dashcalib_ros.report.answer import answer_dict
from dashcalib_ros.report.camera_file import load_camera
from dashcalib_ros.report.camera_yaml import calibration_yaml
from dashcalib_ros.report.compare import Comparison, Difference, compare
from dashcalib_ros.report.files import (
    Written,
    check_writable,
    output_folder,
    remove_leftovers,
    set_aside,
    write_results,
    write_text,
    write_whole,
)
from dashcalib_ros.report.named_camera import NamedCamera, calibrated_camera
from dashcalib_ros.report.page import report_html
from dashcalib_ros.report.result import load_calibration, load_result, result_dict, result_json

__all__ = [
    'Comparison',
    'Difference',
    'NamedCamera',
    'Written',
    'answer_dict',
    'calibrated_camera',
    'calibration_yaml',
    'check_writable',
    'compare',
    'load_calibration',
    'load_camera',
    'load_result',
    'mapping_error',
    'output_folder',
    'remove_leftovers',
    'report_html',
    'result_dict',
    'result_json',
    'set_aside',
    'write_results',
    'write_text',
    'write_whole',
]
