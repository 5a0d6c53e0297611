"""A network of stationary scanners: from people who walk through a building to the scanners' poses (lrf-network).

To be read from the top: pipeline, tracking, pairs, graph, joint, checks, and the estimator as published.
"""
