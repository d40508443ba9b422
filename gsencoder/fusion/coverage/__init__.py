"""What views see of a sample of Gaussians, and which of them show most of a splat: geometry alone."""
