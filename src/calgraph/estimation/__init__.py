"""Joint estimators over all sensors, and the problem that they solve."""
