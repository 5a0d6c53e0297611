"""The room of consensus."""
