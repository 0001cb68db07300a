"""Experiments of no scientific interest, for the tests of the runner."""
