"""The joint estimator of a network of scanners, and what it says for itself."""
