"""Long work on many items, in several processes or machines. It does not depend on motion."""
