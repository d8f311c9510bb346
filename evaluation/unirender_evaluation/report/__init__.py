"""The report of a run: one HTML file with tables, plots and pictures."""
