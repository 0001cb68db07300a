"""Touch-R1 in JAX: a tactile encoder, a small multimodal language model, rewards and one jitted GRPO step."""
