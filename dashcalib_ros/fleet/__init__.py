# SPDX-License-Identifier: Apache-2.0
"""Many clips of many cameras, calibrated with one command: batch.py tells the story."""
