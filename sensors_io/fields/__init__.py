"""What a picture of the gel says about the contact: depth, contact mask, deformation, shear, force."""
