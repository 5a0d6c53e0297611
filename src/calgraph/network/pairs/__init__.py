"""Relative poses of two scanners from tracks of people."""
