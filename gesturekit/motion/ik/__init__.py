"""Inverse kinematics and joint limits."""
