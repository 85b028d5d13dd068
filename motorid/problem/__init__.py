"""A model on records: `problem.Problem` gives whitened residuals and their exact Jacobian; `simulate.simulate`."""
