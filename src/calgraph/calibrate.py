"""The two stories, one screen each."""
