"""Flax Linen modules of the policy: tactile encoder, vision tower, decoder language model, and the policy that joins them."""
