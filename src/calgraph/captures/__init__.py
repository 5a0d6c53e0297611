"""The room of captures."""
