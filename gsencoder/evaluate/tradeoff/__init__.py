"""Cost against accuracy of every stage that has knobs: sweeps, successive halving, Pareto fronts and exponents."""
