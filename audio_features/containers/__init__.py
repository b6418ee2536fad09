"""Sound files: header checks for each container format, and reading by libsndfile."""
