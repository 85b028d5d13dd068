"""A run as measured: `reading.read_runs` makes an `experiment.Experiment` of a file; units end here.

`tables` reads bytes, `headers` finds channels, `cleaning` makes a run; `checks` warns, `preprocessing` mends."""
