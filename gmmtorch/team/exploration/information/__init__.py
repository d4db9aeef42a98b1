"""What a view is worth: mutual information between a map and the next measurements (thesis 4.2)."""
