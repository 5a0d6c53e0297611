"""Surfaces of the surroundings, one flat patch per cell, and trajectories as splines."""
