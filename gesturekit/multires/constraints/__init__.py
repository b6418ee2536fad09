"""Constraints on generated motion: paths, keyframes, in-betweening."""
