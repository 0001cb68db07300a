"""Fields from pictures of the gel: depth, contact mask, deformation, shear, force."""
