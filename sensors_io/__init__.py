"""Tactile sensors in, lossless records and clips out: devices, importers, generated scenes, Grain pipelines."""
