"""Group rollouts, counterfactual touch, advantages, divergences, losses, alarms, and the jitted GRPO step."""
