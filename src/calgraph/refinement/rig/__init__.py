"""The joint estimators of a rig with a board, and what they say for themselves."""
