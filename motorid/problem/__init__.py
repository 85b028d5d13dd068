"""A model on records: `problem` has residual and Jacobian, of `runs` by `unknowns`; `simulate` shows and judges."""
