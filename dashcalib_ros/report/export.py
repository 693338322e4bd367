"""A camera in the formats of other programs. Each takes pixels and coefficients its own way.

COLMAP and nerfstudio count pixels from the first one's corner: its centre is at (0.5, 0.5).
OpenSfM counts from the picture's middle, in units of its longer side. The rest counts as ROS and
OpenCV do.
"""
from __future__ import annotations

import io
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import yaml

from dashcalib_ros.arrays import Floats
from dashcalib_ros.camera import FISHEYE, Camera, ros_camera
from dashcalib_ros.camera.camera import HALF_PIXEL
from dashcalib_ros.camera.field import Field
from dashcalib_ros.errors import ConfigError
from dashcalib_ros.input.source import by
from dashcalib_ros.judge.check import same_shape
from dashcalib_ros.limits import check_pixels
from dashcalib_ros.report.camera_file import EQUIDISTANT, RATIONAL, TERMS, Given, given_camera
from dashcalib_ros.report.result import camera_info_yaml


def export(calibration: Given, kind: str) -> str | bytes:
    """Return a calibration as another program's camera file.

    calibration: a Calibration, what load_camera() returns, a camera, or the path of a file that
    load_camera() reads. kind: opencv, colmap, kalibr, opensfm, nerfstudio, mrcal, ros, foxglove,
    gyroflow, rays or maps.

    Returns the file's text; the bytes of an .npz for rays and maps. Raises InputError for a file
    that cannot be read, and ConfigError for an unknown kind or a lens that it cannot describe.
    """
    found = given_camera(calibration)
    return exported(found.camera, kind, found.field, found.readout_ms)


def exported(camera: Camera, kind: str, field: Field | None = None,
             readout_ms: float | None = None) -> str | bytes:
    """Return the content of a camera file of one of EXPORTS: text, or bytes of an .npz.

    field: what the camera leaves over; WITH_FIELD has the kinds with a place for it, the others
    omit it. readout_ms: of a rolling shutter, from the first row to the last; WITH_READOUT has
    the kinds with a place for it. Raises ConfigError for a kind that does not exist, and for a
    lens that it cannot describe, and OutputError for one that mrcal's spline cannot.
    """
    if kind not in EXPORTS:
        raise ConfigError('E-EXPORT-KIND',
                          f'{kind!r} is no kind of export; use one of {", ".join(EXPORTS)}')
    if kind in WITH_READOUT:
        return WITH_READOUT[kind](camera, readout_ms)
    return WITH_FIELD[kind](camera, field) if kind in WITH_FIELD else EXPORTS[kind](camera)


def check_suffix(path: Path, kind: str) -> None:
    """Raise ConfigError where a file's name promises another content than an export's."""
    # exported() refuses a kind that does not exist
    known = SUFFIXES.get(kind)
    if known and path.suffix.lower() not in known:
        raise ConfigError('E-EXPORT-SUFFIX',
                          f'--to {kind} writes {" or ".join(filter(None, known))}, not what '
                          f'{path.name!r} says; use --out {path.with_suffix(known[0])}')


def resized(camera: Camera, size: tuple[int, int]) -> Camera:
    """Return the camera of pictures that were resized to (width, height).

    Raises ConfigError where that would stretch them, and InputError beyond limits.
    """
    if min(size) < 1:
        raise ConfigError('E-SIZE-NOT-POSITIVE',
                          f'{by(size)} is no size of a picture; write its width and height in px')
    check_pixels(*size, 'the resized picture')
    if not same_shape(camera.image_size, size):
        raise ConfigError('E-SIZE-SHAPE',
                          f'{by(size)} has another shape than the {by(camera.image_size)} of the '
                          f'calibration; if the picture was cropped, use --crop')
    x, y = (new / old for new, old in zip(size, camera.image_size, strict=True))
    return camera.resized(x, size, y)


def cropped(camera: Camera, left: int, top: int, width: int, height: int) -> Camera:
    """Return the camera of a part of its pictures. Raises ConfigError where it sticks out."""
    if (min(left, top) < 0 or min(width, height) < 1 or left + width > camera.image_size[0]
            or top + height > camera.image_size[1]):
        raise ConfigError('E-CROP-OUTSIDE',
                          f'{left},{top},{width},{height} is no part of a picture of '
                          f'{by(camera.image_size)}; write X,Y,W,H in px: the top left corner of '
                          f'the part, and its size')
    return replace(camera, image_size=(width, height), cx=camera.cx - left, cy=camera.cy - top)


def _opencv(camera: Camera) -> str:
    """Return what cv2.FileStorage writes; a fisheye's D is that of cv2.fisheye."""
    file = cv2.FileStorage('.yaml', cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    width, height = camera.image_size
    file.write('image_width', width)
    file.write('image_height', height)
    file.write('camera_model', 'fisheye' if _is_fisheye(camera) else 'pinhole')
    file.write('camera_matrix', camera.matrix)
    file.write('distortion_coefficients', np.array([camera.ros_distortion()]))
    return str(file.releaseAndGetString())


def _colmap(camera: Camera) -> str:
    """Return COLMAP's cameras.txt."""
    width, height = camera.image_size
    values = ' '.join(repr(float(value)) for value in camera.colmap.values(camera.params))
    return ('# Camera list with one line of data per camera:\n'
            '#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n'
            f'1 {camera.colmap.name} {width} {height} {values}\n')


def _kalibr(camera: Camera) -> str:
    """Return kalibr's camchain.yaml."""
    return str(yaml.safe_dump({'cam0': {
        'camera_model': 'pinhole',
        'intrinsics': [camera.fx, camera.fy, camera.cx, camera.cy],
        'distortion_model': 'equidistant' if _is_fisheye(camera) else 'radtan',
        'distortion_coeffs': list(_coefficients(camera, 4, 'kalibr').values()),
        'resolution': list(camera.image_size),
        'rostopic': '/image_raw'}}, sort_keys=False, default_flow_style=None))


def _opensfm(camera: Camera) -> str:
    """Return OpenSfM's camera_models.json."""
    width, height = camera.image_size
    longer = max(width, height)
    kind = 'fisheye_opencv' if _is_fisheye(camera) else 'brown'
    return json.dumps({f'v2 dashcam {width} {height} {kind} 0': {
        'projection_type': kind, 'width': width, 'height': height,
        'focal_x': camera.fx / longer, 'focal_y': camera.fy / longer,
        'c_x': (camera.cx + HALF_PIXEL - width / 2) / longer,
        'c_y': (camera.cy + HALF_PIXEL - height / 2) / longer,
        **_coefficients(camera, 5, 'opensfm')}}, indent=2) + '\n'


def _nerfstudio(camera: Camera) -> str:
    """Return the camera's part of nerfstudio's transforms.json; the frames are to be added."""
    width, height = camera.image_size
    return json.dumps({
        'camera_model': 'OPENCV_FISHEYE' if _is_fisheye(camera) else 'OPENCV',
        'w': width, 'h': height,
        'fl_x': camera.fx, 'fl_y': camera.fy, 'cx': camera.cx + HALF_PIXEL,
        'cy': camera.cy + HALF_PIXEL,
        **_coefficients(camera, 5, 'nerfstudio'), 'frames': []}, indent=2) + '\n'


def _foxglove(camera: Camera) -> str:
    """Return Foxglove's CameraCalibration as JSON, where a fisheye is kannala_brandt."""
    ros = ros_camera(camera)
    width, height = ros.image_size
    return json.dumps({
        'timestamp': {'sec': 0, 'nsec': 0}, 'frame_id': 'camera', 'width': width, 'height': height,
        'distortion_model': 'kannala_brandt' if _is_fisheye(camera) else ros.distortion_model,
        'D': ros.d, 'K': ros.k, 'R': ros.r, 'P': ros.p}, indent=2) + '\n'


def _gyroflow(camera: Camera, readout_ms: float | None = None) -> str:
    """Return a lens profile of Gyroflow, which treats all that it lacks as unknown.

    readout_ms: of a rolling shutter, from the first row to the last. Raises ConfigError for a
    fisheye without coefficients.
    """
    kind = 'opencv_fisheye' if _is_fisheye(camera) else 'opencv_standard'
    d = camera.ros_distortion()
    if _is_fisheye(camera) and not any(d):
        raise ConfigError('E-EXPORT-FISHEYE-ZERO',
                          'gyroflow reads a fisheye whose coefficients are all 0 as a pinhole; '
                          'calibrate with --model fisheye, or export to opencv')
    width, height = camera.image_size
    size = {'w': width, 'h': height}
    return json.dumps({
        'name': f'dashcam {width}x{height}', 'camera_model': 'dashcam',
        'calibrated_by': 'dashcalib', 'calibrator_version': 'dashcalib',
        'calib_dimension': size, 'orig_dimension': size,
        'frame_readout_time': None if readout_ms is None else abs(readout_ms),
        'frame_readout_direction': None if readout_ms is None else (
            'TopToBottom' if readout_ms >= 0 else 'BottomToTop'),
        'input_horizontal_stretch': 1.0, 'input_vertical_stretch': 1.0,
        # else the principal point is taken to be in the middle
        'asymmetrical': True,
        'distortion_model': kind, 'use_opencv_fisheye': _is_fisheye(camera),
        'fisheye_params': {'camera_matrix': camera.matrix.tolist(),
                           'distortion_coeffs': list(d)}}, indent=2) + '\n'


def _mrcal(camera: Camera, field: Field | None = None) -> str:
    """Return mrcal's .cameramodel: the splined one for a fisheye, which it has not, and a field.

    field: what the camera leaves over.
    """
    if field is None and not _is_fisheye(camera):
        d = camera.ros_distortion()
        name, lens = f'LENSMODEL_OPENCV{len(d)}', np.array([*camera.params[:4], *d])
    else:
        # it takes half a second to load
        from dashcalib_ros.report.splined import splined_lens
        name, lens = splined_lens(camera, field)
    values = ', '.join(repr(float(value)) for value in lens)
    width, height = camera.image_size
    return (f"{{\n    'lensmodel':  '{name}',\n"
            f"    'intrinsics': [ {values} ],\n"
            f"    'extrinsics': [ 0, 0, 0, 0, 0, 0 ],\n"
            f"    'imagersize': [ {width}, {height} ],\n}}\n")


def rays_file(camera: Camera, field: Field | None = None) -> bytes:
    """Return an .npz with rays (h, w, 3): the unit viewing ray of each pixel, NaN for none.

    field: what the camera leaves over.
    """
    pixels = _pixels(camera)
    ideal = pixels if field is None else field.ideal(pixels)
    return _npz(camera, rays=camera.rays(ideal).astype(np.float32))


def maps_file(camera: Camera, field: Field | None = None) -> bytes:
    """Return an .npz with map_x, map_y (h, w) for cv2.remap: to a pinhole with the same K.

    field: what the camera leaves over.
    """
    x, y = np.moveaxis((_pixels(camera) - [camera.cx, camera.cy]) / [camera.fx, camera.fy], -1, 0)
    # cv2.remap leaves black what is outside
    pixels = camera.project(np.stack([x, y, np.ones_like(x)], -1))
    found = np.nan_to_num(pixels if field is None else field.observed(pixels), nan=-1.0)
    return _npz(camera, map_x=found[..., 0].astype(np.float32),
                map_y=found[..., 1].astype(np.float32))


def _pixels(camera: Camera) -> Floats:
    """Return the coordinates (h, w, 2) of all pixels."""
    width, height = camera.image_size
    return np.stack(np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float)), -1)


def _npz(camera: Camera, **arrays: npt.NDArray[np.float32]) -> bytes:
    """Return an .npz of arrays, and of the camera that they are of."""
    file = io.BytesIO()
    both: dict[str, Any] = {
        **arrays, 'K': camera.matrix, 'D': np.array(camera.ros_distortion()),
        'distortion_model': np.array(camera.ros_model), 'image_size': np.array(camera.image_size)}
    np.savez(file, **both)
    return file.getvalue()


def _coefficients(camera: Camera, most: int, program: str) -> dict[str, float]:
    """Return the distortion coefficients by OpenCV's names, as many as the program has.

    Raises ConfigError where others of the camera are not 0.
    """
    named = dict(zip(TERMS[EQUIDISTANT if _is_fisheye(camera) else RATIONAL],
                     camera.ros_distortion(), strict=False))
    more = [name for name in list(named)[most:] if named[name]]
    if more:
        raise ConfigError('E-EXPORT-LENS',
                          f'{program} has no {", ".join(more)}; calibrate with --model radial, or '
                          f'export to opencv')
    return dict(list(named.items())[:most])


def _is_fisheye(camera: Camera) -> bool:
    return camera.family == FISHEYE


EXPORTS: dict[str, Callable[[Camera], str | bytes]] = {
    'opencv': _opencv, 'colmap': _colmap, 'kalibr': _kalibr, 'opensfm': _opensfm,
    'nerfstudio': _nerfstudio, 'mrcal': _mrcal, 'ros': camera_info_yaml, 'foxglove': _foxglove,
    'gyroflow': _gyroflow, 'rays': rays_file, 'maps': maps_file}
# what a file's name may end with; the first is offered. Any text may be called so, or nothing
SUFFIXES: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(('opencv', 'kalibr', 'ros'), ('.yaml', '.yml', '.txt', '')),
    **dict.fromkeys(('opensfm', 'nerfstudio', 'foxglove', 'gyroflow'), ('.json', '.txt', '')),
    'colmap': ('.txt', ''), 'mrcal': ('.cameramodel', '.txt', ''),
    'rays': ('.npz',), 'maps': ('.npz',)}
# those with a place for a field
WITH_FIELD: dict[str, Callable[[Camera, Field | None], str | bytes]] = {
    'mrcal': _mrcal, 'rays': rays_file, 'maps': maps_file}
# those with a place for a readout time
WITH_READOUT: dict[str, Callable[[Camera, float | None], str | bytes]] = {'gyroflow': _gyroflow}
