"""A run as measured: `reading.read_runs` makes an `experiment.Experiment` of a file; units end here.

Bytes become a table in `text_tables` or `binary_tables`, its columns channels by `headers` and `layout`, and these
a run in `cleaning`; `checks` says what looks wrong with it, `preprocessing` mends what a user asks for."""
