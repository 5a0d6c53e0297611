"""Intrinsics of cameras from views of the board."""
