"""Group rollouts, advantages, divergences, losses, and the one jitted GRPO step that joins them."""
