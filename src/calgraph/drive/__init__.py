"""Robots that drive: sensors that share no view, without a target, from their motion and common surroundings."""
