"""Train and score the arms of a study."""
