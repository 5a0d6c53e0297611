"""Surfaces of the surroundings, one flat patch per cell, points on them, and trajectories as splines."""
