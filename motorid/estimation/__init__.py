"""From a problem to a fit: `fit.fit`, and `fit.solve` for a problem that is already posed; see there for the plan.

Every stage is one call in `least_squares`; what comes out is `result.Fit`.
"""
