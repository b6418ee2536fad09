"""Human body that any rig can wear: MakeHuman's CC0 base mesh, baked at set-up by `bake.py`."""
