"""The page on what a calibration found, for people."""

from calgraph.report.page import write_report

__all__ = ["write_report"]
