"""Policies that choose which touch to make."""
