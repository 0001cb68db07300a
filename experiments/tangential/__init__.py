"""Of the tangential experiment: scenes, methods, checks, charts."""
