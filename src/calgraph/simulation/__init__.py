"""The room of simulation."""
