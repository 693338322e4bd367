# SPDX-License-Identifier: Apache-2.0
"""Scenes on disk, without pictures: a file of them, and the folder of a camera's turns."""
