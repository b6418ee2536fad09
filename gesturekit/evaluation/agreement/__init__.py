"""Agreement of metrics with the answers of a user study."""
