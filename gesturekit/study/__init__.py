"""User studies: a static page that asks raters, and the analysis of their answers."""

from gesturekit.lazy import attach

__all__, __getattr__, __dir__ = attach(
    __name__,
    {
        "StudyConfig": "config",
        "build_study": "build",
        "read_answers": "analysis.answers",
        "analyse_study": "analysis.result",
        "write_study_report": "analysis.report",
        "raters_needed": "analysis.power",
    },
)
