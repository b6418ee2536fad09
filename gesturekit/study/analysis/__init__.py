"""Analysis of the answers of user studies."""
