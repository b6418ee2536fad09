"""System 2: denoising diffusion with Conformers, guided and mixed by experts.

Alexanderson, Nagy, Beskow and Henter: Listen, Denoise, Action! Audio-Driven Motion Synthesis with
Diffusion Models, SIGGRAPH 2023.
"""
