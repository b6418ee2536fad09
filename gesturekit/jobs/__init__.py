"""Long work on many items: plan, journal, leases and worker processes. It does not depend on
motion."""

from gesturekit.lazy import attach

__getattr__ = attach(
    __name__,
    {},
    {
        "Batch": "run",
        "Execution": "run",
        "FailedItem": "status",
        "History": "journal",
        "Journal": "journal",
        "Lease": "lease",
        "PLAN": "plan",
        "Plan": "plan",
        "Processor": "result",
        "Result": "result",
        "STATE": "state",
        "Status": "status",
        "Task": "task",
        "balanced": "plan",
        "json_of": "result",
        "last_run": "journal",
        "live_leases": "lease",
        "parse_shard": "plan",
        "path_digest": "result",
        "shard_name": "state",
        "status_of": "status",
        "write_plan": "plan",
    },
)[1]
