"""Avatars: a user's own VRM file, worn by motions like the human body."""
