"""Faults: what strikes a run, two small runs for it to strike, and what is left of them."""
