"""Other ways to learn a mixture: hierarchical, variational, deconvolved, Riemannian, sliced Wasserstein."""
