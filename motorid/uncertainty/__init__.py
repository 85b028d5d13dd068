"""How far to trust a fit: `covariance`, `identifiability`, `profile`, `bootstrap`, `multistart`, `batch`.

Each is entered by the function of its name; `batch.fit_many` does the same for the records of many motors.
"""
