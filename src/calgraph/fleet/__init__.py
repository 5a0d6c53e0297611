"""Fleets: the recordings of many robots, calibrated or checked, and what moved when."""
