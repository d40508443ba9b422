"""Adapter heads of a teacher: small MLPs from the features of its backbone to other feature spaces.

RADIO's adapters lead to the spaces of CLIP, SigLIP, DINO and SAM (SplatDistill sec. 3.2). `radio` reads them from the
teacher's folder, `measure` computes mean and scale of their outputs over maps, `store` keeps them on disk beside
features and weights, `apply` gives features and tokens in the space of a head.
"""
