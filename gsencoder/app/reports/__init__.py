"""Pages that commands write about their results."""
