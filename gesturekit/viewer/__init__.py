"""Visualisation of motion: an HTML player with sound, videos, and pictures."""

from gesturekit.lazy import attach

__all__, __getattr__, __dir__ = attach(
    __name__,
    {
        "display": "html",
        "player_data": "html",
        "player_shell": "html",
        "write_fbx": "drawn_body",
        "write_glb": "drawn_body",
        "write_html": "html",
        "write_picture": "pictures",
        "write_video": "video",
        "write_vrma": "drawn_body",
    },
)
