"""Experiments on devices: replays with injected faults, the vendor's Tac3D recordings, decoders side by side."""
