"""Metrics of a policy's answers, the items of the touch bench, and intervals and tests (NumPy)."""
