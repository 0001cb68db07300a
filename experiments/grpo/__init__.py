"""Measuring the GRPO engine: benches, failure scenarios, ablations."""
