"""A run as measured: `reading.read_runs` makes an `experiment.Experiment` of a file; units end here.

Bytes become a table in `tables`, its columns channels by `headers`, and these a run in `cleaning`; `checks` says what
looks wrong with it, `preprocessing` mends what a user asks for."""
