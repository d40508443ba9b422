"""Budgets of encoding: the cheapest setting that keeps a promise is chosen on parts of the scene."""
