"""The one module that loads COLMAP and Ceres.

zlib must be imported first: pycolmap's wheel exports the symbols of another version of zlib, and
the version that a process loads first is used by all its libraries.
"""
from __future__ import annotations

import zlib  # noqa: F401

import pyceres  # its import makes the adjuster's problem a pyceres.Problem
import pycolmap

# what they log goes to stderr anyway; without this, each also leaves files of it in TMPDIR
for library in (pycolmap, pyceres):
    library.logging.logtostderr = True

__all__ = ['pyceres', 'pycolmap']
