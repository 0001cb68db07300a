"""A policy for real recordings: videos to touches, their fixed description, encoder and decoder, cross-validation."""
