"""A run as measured: `reading.read_runs` makes an `experiment.Experiment` of a file; units end here."""
