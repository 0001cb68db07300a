"""What the tables of the paper are made of: baselines, rungs, their differences, questions, further ways to ask."""
