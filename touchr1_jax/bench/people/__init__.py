"""Work of people on the bench: labels by two annotators, blind audits of items, the sheets that they fill in."""
