"""The room of pairwise."""
