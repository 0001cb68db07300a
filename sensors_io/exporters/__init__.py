"""Records in the formats of other programs, and back where a format can hold all of them."""
