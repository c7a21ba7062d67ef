"""What to photograph next: poses that tell most about what an asset does not know yet."""
