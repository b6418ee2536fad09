"""Long work on many items: plan, journal, leases and worker processes. It does not depend on
motion."""
