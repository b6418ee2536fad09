"""System 1: small GANs over a pyramid of frame rates, conditioned by FiLM.

Moreno-Villamarin, Hilsmann and Eisert: Multi-Resolution Generative Modeling of Human Motion from
Limited Data, CVMP 2024. It builds on GANimator (Li et al., SIGGRAPH 2022).
"""
