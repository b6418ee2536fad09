"""Visualisation of motion: an HTML player with sound, videos, and pictures."""

from gesturekit.lazy import attach

__all__, __getattr__, __dir__ = attach(
    __name__,
    {
        "display": "html",
        "player_data": "html",
        "player_shell": "html",
        "write_fbx": "scenes",
        "write_glb": "scenes",
        "write_html": "html",
        "write_picture": "pictures",
        "write_video": "video.writer",
        "write_vrma": "scenes",
    },
    {
        "Buffers": "video.scene",
        "COLOURS": "video.mesh",
        "Camera": "video.scene",
        "DrawnBody": "drawn_body",
        "Figure": "figure",
        "Fitting": "human.body",
        "Human": "human.body",
        "LEFT": "anatomy",
        "MIDDLE": "anatomy",
        "Mannequin": "video.mesh",
        "RIGHT": "anatomy",
        "Scene": "video.scene",
        "SkinnedBody": "video.mesh",
        "is_baked": "human.body",
        "load_avatar": "avatars",
        "simplified": "avatars",
    },
)
