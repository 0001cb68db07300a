"""Speed, stability and scale of GRPO and of its data feeds."""
