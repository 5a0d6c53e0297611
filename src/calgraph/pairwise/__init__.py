"""Relative poses of sensor pairs: RANSAC over captures of a board, or registration of simultaneous tracks."""
