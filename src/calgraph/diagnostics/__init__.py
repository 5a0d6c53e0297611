"""Tests of a result: verdicts, cross-validation, bootstrap, comparisons, suggestions."""
