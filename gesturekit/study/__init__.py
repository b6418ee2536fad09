"""User studies: a static page that asks raters, and the analysis of their answers.

`gesturekit.evaluation.read_answers` reads the answers.
"""

from gesturekit.lazy import attach

__all__, __getattr__, __dir__ = attach(
    __name__,
    {
        "StudyConfig": "config",
        "build_study": "build",
        "analyse_study": "analysis",
        "write_study_report": "report",
        "raters_needed": "power",
    },
    {"CODES": "build", "REASONS": "build", "Votes": "analysis"},
)
