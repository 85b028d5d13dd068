"""What a reader takes home: one page of a result (`report.report`), and the fit to play with (`explorer.explore`)."""
