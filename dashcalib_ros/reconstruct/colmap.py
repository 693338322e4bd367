"""The one module that loads COLMAP and Ceres.

zlib must be imported first: pycolmap's wheel exports the symbols of another version of zlib, and
the version that a process loads first is used by all its libraries.
"""
from __future__ import annotations

import zlib  # noqa: F401

import pyceres  # its import makes the adjuster's problem a pyceres.Problem
import pycolmap

__all__ = ['pyceres', 'pycolmap']
