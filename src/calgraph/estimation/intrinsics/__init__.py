"""Intrinsics of a camera from the corners of boards in its images alone."""
