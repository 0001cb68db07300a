"""Kills, damaged files, failing devices and bad input."""
