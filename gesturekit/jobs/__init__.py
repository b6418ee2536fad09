"""Long work on many items: plan, journal, leases and worker processes. Knows nothing of motion."""
