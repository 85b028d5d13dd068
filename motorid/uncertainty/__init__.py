"""How far to trust a fit: `covariance`, `identifiability`, `profile`, `bootstrap`, `multistart`; `batch`: many fits."""
