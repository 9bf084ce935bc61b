"""Collections of many shapes of one kind: fits, maps between any two, atlases and statistics."""
