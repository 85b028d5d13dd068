"""Algorithms that know no motor: `least_squares`, `autoregression`, `signals` with their noise, `parallel`."""
