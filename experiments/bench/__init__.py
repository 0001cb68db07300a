"""Questions about touch: make, check and score them."""
