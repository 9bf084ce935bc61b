"""Many shapes at once: what is learned from all of them."""
