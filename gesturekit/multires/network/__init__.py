"""Networks of the pyramid in plain torch."""
