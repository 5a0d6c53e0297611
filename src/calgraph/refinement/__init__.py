"""The room of refinement."""
