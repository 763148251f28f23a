"""`nlt stress`: where methods break."""
