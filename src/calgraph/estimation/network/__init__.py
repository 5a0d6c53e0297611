"""Networks of 2-D scanners."""
