"""Flax Linen modules: tactile encoder, vision tower, decoder language model, and the policy that joins them."""
