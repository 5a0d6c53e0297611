"""The estimators of lrf-network as published, where they are not the default."""
