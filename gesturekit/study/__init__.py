"""User studies: a static page that asks raters, and the analysis of their answers.

`gesturekit.evaluation.read_answers` reads the answers.
"""

from gesturekit.lazy import attach

__all__, __getattr__, __dir__ = attach(
    __name__,
    {
        "CODES": "build",
        "REASONS": "build",
        "StudyConfig": "config",
        "Votes": "analysis.votes",
        "analyse_study": "analysis.result",
        "build_study": "build",
        "raters_needed": "analysis.significance",
        "write_study_report": "analysis.report",
    },
)
