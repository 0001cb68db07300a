"""One program on many devices: the mesh, who holds what on it, and what a step needs of each device."""
