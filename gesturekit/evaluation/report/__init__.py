"""The report: tables, plots, page, and what the metrics notice of known-bad motion."""
