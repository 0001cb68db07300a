"""Sensors as they are plugged in: cameras, UDP streams, vendor processes, force sensors, replays, generated scenes."""
