"""Recordings below `shared_data`, each of another rig."""

ZEGGS = "paired/zeggs_067_Speech_2/067_Speech_2_x_1_0.bvh"
AITVIEWER = "motion/aitviewer/sample.bvh"
IDLE = "motion/reactidle/003_genuine.bvh"
BANDAI = "motion/bandai/dataset-1_bye_happy_001.bvh"
RUN = "smpl/glamr_running_smpl.npz"
RECORDED = (ZEGGS, AITVIEWER, IDLE, BANDAI, RUN)
