"""Check that other programs open the files that meshmatch writes, with the same content."""
