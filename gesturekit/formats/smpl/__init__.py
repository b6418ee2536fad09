"""SMPL, AMASS and EasyMocap files."""
