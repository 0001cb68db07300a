"""Of the contact experiments: scenes, methods, oracles, failures, charts."""
