"""Which physical effect is missing: `diagnose.diagnose` is the entry, `stepwise.improve` the ladder it climbs."""
