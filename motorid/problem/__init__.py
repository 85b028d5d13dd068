"""A model on records: `problem.Problem` gives whitened residuals and their exact Jacobian.

`runs` makes records ready, `unknowns` says what is sought, `simulate` shows a model on records and judges it there.
"""
