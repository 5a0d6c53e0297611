"""Grades of a result, tests of its parameters, and comparison with given poses."""
