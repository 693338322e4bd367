"""Scenes -> one shared camera, its covariance, and the information that each turn gives."""
