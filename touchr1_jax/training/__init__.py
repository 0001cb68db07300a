"""Training: the stages' jitted steps, and the loop and checkpoints, the only side effects of this package."""
