"""Motion files in and out: BVH, and npz of our own and of SMPL rigs."""

from gesturekit.formats.bvh import read_bvh, write_bvh
from gesturekit.formats.npz import read_npz, write_npz

__all__ = ["read_bvh", "read_npz", "write_bvh", "write_npz"]
