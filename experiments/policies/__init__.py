"""Training and scoring of policies: data, feeds, stages, baselines, one study."""
