"""From pictures of a ball pressed into the gel to a map from colour to slope, with no hand labelling."""
