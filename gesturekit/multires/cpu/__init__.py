"""CPU engine: the multires networks' slowest operations, compiled by numba.

Optional: without this folder `multires/backend.py` takes plain torch (`multires/networks.py`).
"""
