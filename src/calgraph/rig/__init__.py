"""A robot with a board: from one recording of a board carried around it to its tree of transforms (MSG-Cal).

To be read from the top: pipeline, captures, detection, pairs, bundle, intrinsics, checks, and the estimator as
published.
"""
