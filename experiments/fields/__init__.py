"""Depth, motion and force fields, measured on known and real data."""
