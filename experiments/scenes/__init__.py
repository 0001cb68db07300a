"""Of the experiments on generated scenes: rates, sheets, realism."""
