"""One accelerator: what it is, and the pieces of training that are timed on it."""
