"""What is reported about a policy: metrics of its answers, and intervals and tests on those metrics (NumPy)."""
