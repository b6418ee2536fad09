"""Avatars: a user's own VRM file, to which motion is retargeted, as to the human body."""
