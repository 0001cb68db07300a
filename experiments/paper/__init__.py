"""The paper's tables, ladders and ablations, and released weights."""
