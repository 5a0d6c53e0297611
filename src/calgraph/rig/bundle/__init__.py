"""The joint solution of a rig: poses, boards and systematic errors."""
