"""The joint solution of a network: poses, clocks, paths, bodies and systematic errors."""
