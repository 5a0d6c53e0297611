"""Tracking of moving objects in the scans of one stationary 2-D scanner."""
