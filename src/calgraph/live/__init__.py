"""Live capture: from the messages of a running robot to its calibration, with feedback while it is recorded.

A source receives messages, the recorder writes them, and the session detects the board in them, calibrates after
each capture, and states what the operator's page shows. The result is that of ``calgraph calibrate`` on the
recording.
"""
