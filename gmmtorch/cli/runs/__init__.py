"""What commands do that is too large for their own file."""
