"""HTML pages that show two shapes and the map between them, or one that changes; three.js is included (see README.md)."""
