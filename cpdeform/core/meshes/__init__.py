"""Triangle meshes: reading and repair, what is inside of them, signed-distance grids, particles that fill them evenly."""
