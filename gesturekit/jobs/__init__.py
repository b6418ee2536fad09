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
        "json_of": "result",
        "path_digest": "result",
        "status_of": "status",
    },
)[1]
