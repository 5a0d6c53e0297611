"""The graph of sensors: connectivity and start values."""
