"""The commands of `python -m sensors_io`, one file each."""
