"""Algorithms that know no motor: `least_squares`, `autoregression`, `noise`, `signals`, `parallel`."""
