"""The evaluation report: comparison, tables, plots, page."""
