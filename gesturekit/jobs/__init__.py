"""Long work on many items, in several processes or machines. It does not depend on motion."""

from gesturekit.lazy import attach

__getattr__ = attach(
    __name__,
    {},
    {
        "Batch": "batch",
        "Execution": "batch",
        "FailedItem": "status",
        "Processor": "result",
        "Result": "result",
        "STATE": "records",
        "Status": "status",
        "Task": "result",
        "all_records": "records",
        "claimed": "records",
        "json_of": "result",
        "path_digest": "result",
        "read_items": "records",
        "read_record": "records",
        "running": "records",
        "shard_of": "records",
        "status_of": "status",
        "write_items": "records",
        "write_record": "records",
    },
)[1]
