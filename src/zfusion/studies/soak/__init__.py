"""Long runs: whether anything grows that should not."""
