# SPDX-License-Identifier: Apache-2.0
"""The table of formats: how each is recognised, read and written.

A new format is a module and a row here. A reader returns the cameras that a content has, by name;
none where the content is of another format.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dashcalib_ros.formats import (
    calibrators,
    colmap,
    datasets,
    opencv,
    ours,
    photogrammetry,
    plain,
    ros,
    slam,
    urdf,
)
from dashcalib_ros.formats.values import Cameras
from dashcalib_ros.judge.difference import NamedCamera


@dataclass(frozen=True)
class Format:
    """One format of camera files.

    in_text: reads a file's text. in_data: reads what JSON, YAML, XML or an .npz have. write:
    returns a file's content. suffixes: what the name of such a file may end with; the first is
    offered. keeps: the fields of a NamedCamera that have a place in it, besides the camera.
    """

    in_text: Callable[[str, Path], Cameras] | None = None
    in_data: Callable[[Any, Path], Cameras] | None = None
    write: Callable[[NamedCamera], str | bytes] | None = None
    suffixes: tuple[str, ...] = ()
    keeps: tuple[str, ...] = ()


# any text may be called so, or nothing
TEXT = ('.txt', '')
YAML, JSON = ('.yaml', '.yml', *TEXT), ('.json', *TEXT)
# the first that has a camera in a content reads it: a lens profile of Gyroflow has a part that
# looks like one of Kalibr, and opencv takes all with a camera matrix
FORMATS = {
    'ours': Format(in_data=ours.cameras),
    'kitti': Format(datasets.kitti),
    'nuscenes': Format(in_data=datasets.nuscenes),
    'argoverse': Format(in_data=datasets.argoverse),
    'waymo': Format(in_data=datasets.waymo),
    'cityscapes': Format(in_data=datasets.cityscapes),
    'a2d2': Format(in_data=datasets.a2d2),
    'comma': Format(datasets.comma),
    'vipe': Format(in_data=datasets.vipe),
    'orbslam': Format(None, slam.orbslam, slam.write_orbslam, YAML),
    'vins': Format(None, slam.vins, slam.write_vins, YAML),
    'openvins': Format(write=calibrators.write_openvins, suffixes=YAML),
    'stella': Format(None, slam.stella, slam.write_stella, YAML),
    'svo': Format(None, slam.svo, slam.write_svo, YAML),
    'droid': Format(slam.droid, None, slam.write_droid, TEXT),
    'metashape': Format(photogrammetry.metashape, None, photogrammetry.write_metashape,
                        ('.xml', *TEXT)),
    'matlab': Format(None, calibrators.matlab, calibrators.write_matlab, JSON),
    'plain': Format(in_data=plain.cameras),
    'colmap': Format(colmap.cameras, None, colmap.write, TEXT),
    'colmap-db': Format(write=colmap.write_database, suffixes=('.db',)),
    'gyroflow': Format(None, calibrators.gyroflow, calibrators.write_gyroflow, JSON,
                       ('readout_ms',)),
    'kalibr': Format(calibrators.kalibr_results, calibrators.kalibr, calibrators.write_kalibr,
                     YAML),
    'opensfm': Format(None, photogrammetry.opensfm, photogrammetry.write_opensfm, JSON),
    'nerfstudio': Format(None, photogrammetry.nerfstudio, photogrammetry.write_nerfstudio, JSON),
    'mrcal': Format(calibrators.mrcal, None, calibrators.write_mrcal, ('.cameramodel', *TEXT),
                    ('field',)),
    'foxglove': Format(write=ros.write_foxglove, suffixes=JSON),
    'autoware': Format(write=ros.write_autoware, suffixes=YAML),
    'vision_pilot': Format(write=urdf.write_road, suffixes=YAML, keeps=('mount',)),
    'ros': Format(ros.ini_cameras, ros.echoed_cameras, ros.write, YAML),
    'opencv': Format(None, opencv.cameras, opencv.write, YAML),
    'rays': Format(write=opencv.write_rays, suffixes=('.npz',), keeps=('field',)),
    'maps': Format(write=opencv.write_maps, suffixes=('.npz',), keeps=('field',)),
    'urdf': Format(write=urdf.write, suffixes=('.urdf', '.xml', *TEXT), keeps=('mount',)),
    'tf': Format(write=urdf.write_transform, suffixes=('.sh', *TEXT), keeps=('mount',))}
