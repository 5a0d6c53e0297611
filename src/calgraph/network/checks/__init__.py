"""What contradicts the solution of a network, and how far it may be wrong."""
