"""From a problem to a fit: `fit` has the stages in order, each a call in `least_squares`; `result` what comes out."""
