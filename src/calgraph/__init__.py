"""Extrinsic calibration of cameras, laser scanners and LiDARs from one recording."""
