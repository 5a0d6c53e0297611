"""Holds: the times in which the board rests; the messages measured in them, and the detections of the board."""
