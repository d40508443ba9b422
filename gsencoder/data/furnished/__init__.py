"""Furnished rooms by a seed: libraries of models, plans, surfaces, and what a walk with a camera sees."""
