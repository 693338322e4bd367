"""Blocks, observations, steps: what every adjustment of the package is made of."""
