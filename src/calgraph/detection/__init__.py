"""Detection of the board in the messages of one capture."""
