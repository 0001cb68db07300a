"""Tactile sensors in, lossless records and training clips out: devices, importers, generated scenes, Grain pipelines."""
