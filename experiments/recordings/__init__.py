"""Policies on real recordings."""
