"""What robots tell one another, as bytes, and the networks that carry it."""
