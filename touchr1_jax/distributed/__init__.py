"""Training on many devices: the mesh, the sharding rules, and the memory and time of a step on each device."""
