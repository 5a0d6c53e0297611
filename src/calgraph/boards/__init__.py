"""Printed boards: patterns, finders, poses from their corners, and what sensors detect of a board."""
