"""From data or aims to parameters: `fit` and `design`."""
