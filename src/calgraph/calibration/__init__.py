"""The pipelines of rigs and networks: from a recording to a calibrated tree of transforms."""
