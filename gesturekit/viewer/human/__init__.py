"""Human body for motion of any rig: MakeHuman's CC0 base mesh, baked at set-up by `bake.py`."""
