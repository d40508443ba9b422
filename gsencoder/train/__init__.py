"""Training: prepared scenes, samples, losses, and the loop over them."""
