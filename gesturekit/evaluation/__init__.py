"""Evaluation of motion: metrics and the report. Independent of models."""

from gesturekit.lazy import attach

_PUBLIC = {
    "comparison": "evaluate",
    "definitions": "Variants",
    "metrics.frechet.clip_features": "geometric_features kinetic_features",
    "metrics.frechet.feature_model": "FeatureModel load_extractor",
    "metrics.frechet.frechet": (
        "FrechetResult clip_diversity fgd fid frechet_distance frechet_result raw_fgd"
    ),
    "metrics.frechet.poses": "PoseWindows",
    "metrics.hands": (
        "CalmAndLively HandMovement body_centred calibration calm_and_lively hand_movement "
        "hand_paths hand_speed upper_joints"
    ),
    "metrics.patches": (
        "PatchScores coverage global_diversity inter_diversity intra_diversity local_diversity "
        "patch_features patch_scores"
    ),
    "metrics.physical": (
        "JointLimits SpeedHistogram acceleration arm_speed arm_speed_ratio bone_length_change "
        "feet_above_floor floor_penetration foot_skate hellinger jerk jerk_ratio "
        "joint_limit_share joint_speed max_speed standing_heights worst_joint wrist_speed"
    ),
    "metrics.rhythm": (
        "BeatResult beat_alignment beat_consistency motion_beats music_beats speech_onsets"
    ),
    "metrics.mouth": "mouth_agreement mouth_opening",
    "metrics.similarity": "cca l1_diversity pose_rmse root_relative srgr vertex_lvd vertex_mse",
    "metrics.sync": "SyncResult speech_envelope sync",
    "metrics.two_sample": (
        "Copying MotionWindows copying motion_windows two_sample_accuracy within_reach"
    ),
    "pairs": "Items",
    "report.page": "write_report",
    "results": "Evaluation",
    "statistics.answers": "read_answers read_ratings",
}
"""Names of the documented interface by module."""
_INTERNAL = {
    "definitions": "DEFINITIONS GROUPS MOVEMENT POOLED definitions_of",
    "measuring.clip_metrics": "ClipMetrics quick_metrics",
    "measuring.clips": "Clip load_clip read_semantic",
    "metrics.physical": "derivative low_passed",
    "pairs": "BareItem Excluded Pair find_pairs",
    "report.text": "headline_lines interval_warnings",
    "results": "ClipResult Interval Level MetricResult ModelResult QuestionAnswer",
    "statistics.answers": "Answer Answers GENEA_COLUMNS",
    "statistics.intervals": (
        "Takes holm interval_of interval_of_statistic interval_over_samples pseudo_values "
        "scaled_like standard_error whole_set"
    ),
    "statistics.model_metrics": "above_chance metric_results",
    "statistics.paired": "contests distance p_of_difference",
    "statistics.questions": "answer_questions answers_of verdict",
}
"""Names that are imported within the project."""
__all__, __getattr__, __dir__ = attach(
    __name__,
    *(
        {name: module for module, names in table.items() for name in names.split()}
        for table in (_PUBLIC, _INTERNAL)
    ),
)
