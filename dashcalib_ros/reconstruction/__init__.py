"""Turns -> tracks -> one scene per turn, and the adjustment of scenes with one shared camera."""
