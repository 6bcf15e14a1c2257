"""What in a task would go wrong without a word: one small function a kind, each returning findings as data."""
