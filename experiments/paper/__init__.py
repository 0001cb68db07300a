"""The paper's tables and ablations, and training on released weights."""
