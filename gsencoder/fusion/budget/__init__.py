"""Budgets of fusion: the cheapest setting that keeps a promise is chosen on a sample of the scene."""
