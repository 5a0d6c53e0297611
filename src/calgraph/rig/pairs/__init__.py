"""Relative poses of two sensors from captures of the board."""
