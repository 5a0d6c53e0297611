"""What a result says of itself: grades, tests of its parameters, and comparison with given poses."""
