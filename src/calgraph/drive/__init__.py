"""A robot with LiDARs that drives past surfaces: its sensors' poses, without a board.

To be read from the top: adjustment, start, odometry, sweeps.
"""
