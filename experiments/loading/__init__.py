"""Checkpoints of released shapes with random contents, and processes of their own that read them."""
