"""What contradicts the solution of a rig, and how far it may be wrong."""
