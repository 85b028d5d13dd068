"""motorid."""
