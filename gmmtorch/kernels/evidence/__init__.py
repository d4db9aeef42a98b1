"""Evidence of components: at points, as flux and mass in cells, and the test of which cones are near."""
