"""Rigs with a board."""
