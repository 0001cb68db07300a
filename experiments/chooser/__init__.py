"""Of the chooser's trial: the bench, the fit, charts."""
