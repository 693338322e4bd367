# SPDX-License-Identifier: Apache-2.0
"""Blocks, observations, steps: what every adjustment of the package is made of."""
