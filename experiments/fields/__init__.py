"""Of the field experiments: known motion on real pictures, generated slides, methods, peers, charts."""
