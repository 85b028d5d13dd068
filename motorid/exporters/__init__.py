"""A fitted model for other programs: `export.export` writes it as CasADi function, C or JSON, `load` reads it."""
