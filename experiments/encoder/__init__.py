"""Pretraining of the tactile encoder, measured."""
