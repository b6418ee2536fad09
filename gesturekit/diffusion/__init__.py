"""System 2: denoising diffusion with Conformers, guidance and products of experts.

Alexanderson, Nagy, Beskow and Henter: Listen, Denoise, Action! Audio-Driven Motion Synthesis with
Diffusion Models, SIGGRAPH 2023.
"""
