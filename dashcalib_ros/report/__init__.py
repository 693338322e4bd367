"""calibration.yaml, result.json, report.html; comparisons; what a terminal shows: tables.py."""
from dashcalib_ros.report.camera import Camera, camera_of, load_camera
from dashcalib_ros.report.camera_yaml import calibration_yaml, load_calibration_yaml
from dashcalib_ros.report.compare import Comparison, Difference, compare
from dashcalib_ros.report.files import check_writable, output_folder, write_results, write_text
from dashcalib_ros.report.mapping import mapping_error
from dashcalib_ros.report.page import report_html
from dashcalib_ros.report.result import load_result, result_dict, result_json

__all__ = [
    'Camera',
    'Comparison',
    'Difference',
    'calibration_yaml',
    'camera_of',
    'check_writable',
    'compare',
    'load_calibration_yaml',
    'load_camera',
    'load_result',
    'mapping_error',
    'output_folder',
    'report_html',
    'result_dict',
    'result_json',
    'write_results',
    'write_text',
]
