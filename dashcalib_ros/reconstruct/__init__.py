"""Turns -> tracks -> one scene per turn; the bundle adjustment of scenes that share a camera."""
