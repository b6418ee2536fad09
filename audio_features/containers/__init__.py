"""Sound files and arrays: header checks for each container format, reading, and repairs."""
