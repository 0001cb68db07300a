"""The released model on the paper's machine: what a step needs of each device, without weights or the machine."""
